"""The flow fields of a stream's spec are what the estimators know, and reach them."""

from __future__ import annotations

from typing import get_args

import pytest

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import FlowMethod, StreamSpec
from v2v_server.flow import AUTO, METHODS, FlowSettings


def test_both_sides_know_the_same_names() -> None:
    assert (AUTO, *METHODS) == get_args(FlowMethod)
    assert FlowSettings.of(StreamSpec()) == FlowSettings()


def test_settings_of_a_spec() -> None:
    spec = StreamSpec(flow_method="dis-fast-1", flow_direction="backward", flow_from=20, flow_margin_px=-1)
    assert FlowSettings.of(spec) == FlowSettings("dis-fast-1", "backward", 20, None)


def test_what_cannot_be_is_refused_before_anything_is_sent() -> None:
    for field, wrong in (
        ("flow_method", "dis"), ("flow_direction", "up"), ("flow_from", 41), ("flow_from", -1), ("flow_margin_px", -2),
        ("flow_margin_px", True),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=field):
            StreamSpec(**{field: wrong})  # type: ignore[arg-type]
