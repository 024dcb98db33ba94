"""Bands of rows: what users write, and the released code's rounding."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError
from v2v_server.video.rows import Rows


@pytest.mark.parametrize(
    ("text", "height", "bounds"),
    [
        ("full", 336, (0, 336)),
        ("top:0.54", 336, (0, 181)),
        ("top:1", 336, (0, 336)),
        ("top:180px", 336, (0, 180)),
        ("0.1:0.6", 336, (33, 201)),
        (" 0:.5 ", 7, (0, 3)),
    ],
)
def test_bounds(text: str, height: int, bounds: tuple[int, int]) -> None:
    assert Rows.parse(text).bounds(height) == bounds


@pytest.mark.parametrize(
    "text",
    ["", "top", "top:", "top:0", "top:1.5", "top:0px", "top:-3px", "0.6:0.1", "0.2:0.2", "0:2", "nan:1", "bottom:1"],
)
def test_nonsense(text: str) -> None:
    with pytest.raises(UsageError, match="rows"):
        Rows.parse(text)


def test_pictures_that_are_too_small() -> None:
    with pytest.raises(UsageError, match="120 rows only"):
        Rows.parse("top:180px").bounds(120)
    with pytest.raises(UsageError, match="no row is left"):
        Rows.parse("0.1:0.2").bounds(3)


@given(st.floats(0, 1), st.floats(0, 1))
def test_text_round_trip(top: float, bottom: float) -> None:
    if top < bottom:
        rows = Rows(top, bottom)
        assert Rows.parse(str(rows)) == rows


@pytest.mark.parametrize("text", ["full", "top:0.54", "top:180px", "0.1:0.6"])
def test_canonical_text(text: str) -> None:
    assert str(Rows.parse(text)) == text
