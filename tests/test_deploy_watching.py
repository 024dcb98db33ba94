"""Check that the server exports every metric that `deploy/` uses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import yaml

from tests.server.page.metric_names import metric_names
from v2v_server.commands import serve as serve_command
from v2v_server.config import ServeConfig

DEPLOY = Path(__file__).parents[1] / "deploy"
DASHBOARD: dict[str, Any] = json.loads((DEPLOY / "grafana.json").read_text())
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
_NAME = re.compile(r"\bv2v_\w+")


def queries() -> list[str]:
    return [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]


def test_every_dashboard_query_uses_existing_metrics() -> None:
    names = metric_names()
    assert queries()
    for query in [*queries(), *(each["query"] for each in DASHBOARD["templating"]["list"] if each["type"] == "query")]:
        assert _NAME.findall(query), query
        assert set(_NAME.findall(query)) <= names, query


def test_rates_are_of_counters() -> None:
    for query in queries():
        rates = re.findall(r"(?:rate|increase)\((v2v_\w+)", query)
        assert all(name.endswith("_total") for name in rates), query
        assert set(rates) == {name for name in _NAME.findall(query) if name.endswith("_total")} or "faults" in query


def test_prometheus_uses_a_host_name_that_the_page_accepts(monkeypatch: Any) -> None:
    asked: list[ServeConfig] = []
    monkeypatch.setattr("v2v_server.serve.serve", lambda config, *_: asked.append(config))
    server = COMPOSE["services"]["v2v-server"]
    flags = [flag.replace("${WORKERS:-8}", "8").replace("${ROWS:-full}", "full") for flag in server["command"]]
    assert serve_command.main(["--videos", "/videos", "--insecure", *flags]) == 0
    (config,) = asked
    scrape = yaml.safe_load((DEPLOY / "prometheus.yaml").read_text())["scrape_configs"][0]["static_configs"][0]
    ((host, port),) = (target.split(":") for target in scrape["targets"])
    assert (host, int(port)) == ("v2v-server", config.page)
    assert host in COMPOSE["services"]
    assert host in config.page_names.split(",")
    assert f"127.0.0.1:{config.page}:{config.page}" in server["ports"]
    mounted = COMPOSE["services"]["prometheus"]["volumes"][0].split(":")[0]
    assert (DEPLOY / mounted).is_file()
