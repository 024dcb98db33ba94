"""Texts in JSON that json.loads takes badly."""

from __future__ import annotations

import pytest

from v2v_protocol.persisted import parse_json


@pytest.mark.parametrize(
    ("text", "message"), [("[" * 200_000, "deeply"), ('{"a": "\\ud800"}', "surrogate"), ("{", "Expecting")]
)
def test_what_makes_no_value_is_a_value_error(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_json(text)
