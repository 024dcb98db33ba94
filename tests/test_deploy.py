"""Check that `deploy/` agrees with the commands, and that the server exports every metric that it uses."""

from __future__ import annotations

import json
import re
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.server.page.metric_names import metric_names
from v2v_protocol.errors import UsageError
from v2v_protocol.link.router import Sockets
from v2v_protocol.sample import DEFAULT_ARRAYS, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_server.commands.quarantine import main as quarantine
from v2v_server.commands.serve import main as serve
from v2v_server.config import ServeConfig
from v2v_server.corpus.videos import VideoEntry
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES, WORKER_BYTES, lease_bytes
from v2v_server.video.rows import Rows

DEPLOY = Path(__file__).parents[1] / "deploy"
UNIT = DEPLOY / "systemd" / "v2v-serve.service"
SERVICES = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
DASHBOARD: dict[str, Any] = json.loads((DEPLOY / "grafana.json").read_text())
_NAME = re.compile(r"\bv2v_\w+")


@pytest.fixture(scope="module")
def unit() -> RawConfigParser:
    parser = RawConfigParser(strict=False)  # SystemCallFilter is said twice, which adds to it
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(UNIT.read_text())
    return parser


@pytest.fixture(scope="module")
def service(unit: RawConfigParser) -> dict[str, str]:
    return dict(unit["Service"])


def test_the_unit_does_not_restart_after_a_mistyped_key(
    service: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "serve.yaml").write_text("video: /data/webvid\n")
    status = serve(["--config", str(tmp_path / "serve.yaml")])
    assert "did you mean 'videos'" in capsys.readouterr().err
    assert service["Restart"] == "on-failure"
    assert str(status) in service["RestartPreventExitStatus"].split()


def test_workers_are_given_the_memory_that_the_largest_usual_clip_needs() -> None:
    """The paper's 201 frames, resized from 3840 x 2160; `WORKER_BYTES` is the one place for the number."""
    spec = StreamSpec.from_dict({"recipe": {"preset": "paper", "resize_scale": [0.5, 1.0]}})
    arrays = layout_bytes(array_layout(spec.recipe, spec.voxel_dtype, DEFAULT_ARRAYS))
    needed = lease_bytes(VideoEntry("v.mp4", "f", 999, 3840, 2160, 30.0, "hevc"), Rows(), spec, arrays)
    assert needed <= WORKER_BYTES < 1.1 * needed
    (patch,) = yaml.safe_load((DEPLOY / "kubernetes" / "kustomization.yaml").read_text())["patches"]
    (resources,) = [each["value"] for each in yaml.safe_load(patch["patch"])]
    given = [resources[kind]["memory"] for kind in ("requests", "limits")]
    given += re.findall(r"--mem-per-cpu=(\S+)", (DEPLOY / "slurm" / "train.sbatch").read_text())
    assert [_bytes(text) for text in given] == 3 * [WORKER_BYTES]
    unit = (DEPLOY / "systemd" / "v2v-worker@.service").read_text()
    assert [_bytes(text) for text in re.findall(r"^MemoryMax=(\S+)$", unit, re.M)] == [LARGEST_MEMORY_BYTES]


def _bytes(text: str) -> int:
    number, unit = re.fullmatch(r"(\d+)([MG])i?", text).groups()  # type: ignore[union-attr]
    return int(number) << {"M": 20, "G": 30}[unit]


def test_the_units_example_is_valid_and_its_quarantine_lies_where_it_says(
    service: dict[str, str], tmp_path: Path
) -> None:
    notes = "".join(line for line in UNIT.read_text().splitlines(True) if line.startswith("#"))
    state = f"/var/lib/{service['StateDirectory']}"
    assert service["Environment"] == f"V2V_CACHE_DIR={state}"
    assert f"v2v-quarantine --videos /data/webvid --cache-dir {state}\n" in notes
    quarantine(["--videos", str(tmp_path), "--cache-dir", str(tmp_path)])
    written = re.findall(r"^#   (\w+: .*)$", notes, re.MULTILINE)
    assert ServeConfig.load(None, yaml.safe_load("\n".join(written))).workers == (8, 8)


def test_the_unit_waits_for_its_bind_address(unit: RawConfigParser) -> None:
    # No host has an address in 192.0.2.0/24, so it acts like one that this host does not have yet.
    with pytest.raises(UsageError, match=r"--bind tcp://192\.0\.2\.1:5555"):
        Sockets("tcp://192.0.2.1:5555", "ipc://@v2v-test-deploy")
    assert "network-online.target" in unit["Unit"]["After"].split()
    assert unit["Unit"]["Wants"] == "network-online.target"


def test_a_container_has_minimal_rights() -> None:
    """It does not run as root either: both images set a user."""
    for service in SERVICES.values():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert "privileged" not in service
    assert SERVICES["v2v-server"]["read_only"] is True
    assert SERVICES["v2v-server"]["tmpfs"] == ["/tmp"]
    for file in ("Dockerfile", "trainer.Dockerfile"):
        *_, last = [line for line in (DEPLOY / file).read_text().splitlines() if line.startswith("USER ")]
        assert last == "USER v2v"


# --- metrics ----------------------------------------------------------------------------------------------------------


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


def test_prometheus_uses_a_host_name_that_the_page_accepts(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[ServeConfig] = []
    monkeypatch.setattr("v2v_server.serve.serve", lambda config, *_: asked.append(config))
    server = SERVICES["v2v-server"]
    flags = [flag.replace("${WORKERS:-8}", "8").replace("${ROWS:-full}", "full") for flag in server["command"]]
    assert serve(["--videos", "/videos", "--insecure", *flags]) == 0
    (config,) = asked
    scrape = yaml.safe_load((DEPLOY / "prometheus.yaml").read_text())["scrape_configs"][0]["static_configs"][0]
    ((host, port),) = (target.split(":") for target in scrape["targets"])
    assert (host, int(port)) == ("v2v-server", config.page)
    assert host in SERVICES
    assert host in config.page_names.split(",")
    assert f"127.0.0.1:{config.page}:{config.page}" in server["ports"]
    mounted = SERVICES["prometheus"]["volumes"][0].split(":")[0]
    assert (DEPLOY / mounted).is_file()
