"""Name every metric that a server exports."""

from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from tests.server.peers import peers
from tests.server.status.services import published
from v2v_server.page.app import exposition


def metric_names() -> set[str]:
    """Return the names, as a query writes them, of a service that has everything."""
    at = peers()
    at.join()
    at.hello()
    at.want(0)
    at.work_off()
    content, _ = exposition(published(at, cache="/nowhere").plain())
    families = text_string_to_metric_families(content.decode())
    return {sample.name for family in families for sample in family.samples}
