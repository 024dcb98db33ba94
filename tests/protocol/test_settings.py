"""Settings: what a field's one statement promises."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.settings import (
    Setting,
    check_settings,
    format_value,
    number,
    require_known,
    require_whole,
    settings_of,
    span,
    switch,
    text,
    whole,
    word,
)


@dataclass(frozen=True, slots=True)
class Toy:
    size: int = whole(3, 1, 10, "how large", unit="px", group="Shape")
    share: float = number(0.5, 0.0, 1.0, "how much")
    corner: tuple[float, float] = span((0.0, 0.0), 0.5, 8.0, "from when", unit="Hz", off=True, group="Time")
    is_on: bool = switch(False, "whether")
    kind: Literal["a", "b"] = word("a", Literal["a", "b"], "which")
    name: str = text("", "of whom")
    plain: int = 7

    def __post_init__(self) -> None:
        check_settings(self, "toy {}".format, RecipeError)


def test_a_field_is_known_by_its_statement() -> None:
    known = settings_of(Toy)
    assert list(known) == ["size", "share", "corner", "is_on", "kind", "name"]
    assert [setting.group for setting in known.values()] == ["Shape", "Shape", "Time", "Time", "Time", "Time"]
    assert [setting.default for setting in known.values()] == [3, 0.5, (0.0, 0.0), False, "a", ""]
    assert known["kind"].words == ("a", "b")


def test_values_take_the_type_of_their_field() -> None:
    toy = Toy(share=1, corner=2)  # type: ignore[arg-type]
    assert (toy.share, type(toy.share), toy.corner) == (1.0, float, (2.0, 2.0))
    assert math.copysign(1.0, Toy(share=-0.0).share) == 1.0
    assert Toy(corner=[1, 2]).corner == (1.0, 2.0)  # type: ignore[arg-type]
    # YAML 1.1 takes 1e-3, without a point, for text.
    assert Toy(share="1e-3", corner=["1e0", 2]) == Toy(share=0.001, corner=(1.0, 2.0))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("size", 0, "toy size = 0: give a whole number from 1 to 10 px"),
        ("size", 2.0, "toy size = 2.0: give a whole number from 1 to 10 px"),
        ("size", True, "toy size = True: give a whole number from 1 to 10 px"),
        ("share", 1.5, "toy share = 1.5: give a number from 0 to 1"),
        ("share", math.nan, "toy share = nan: give a number from 0 to 1"),
        ("share", "half", "toy share = 'half': give a number from 0 to 1"),
        (
            "corner", [0.0, 4.0],
            "toy corner = [0.0, 4.0]: give one number, or a pair [lowest, highest], from 0.5 to 8 Hz, or 0 for off",
        ),
        ("corner", (4.0, 2.0), "toy corner = [4.0, 2.0]: the lowest value comes first"),
        ("is_on", 1, "toy is_on = 1: give true or false"),
        ("kind", "c", "toy kind = 'c': choose one of a, b"),
        (
            "kind", False,
            "toy kind = False: choose one of a, b (YAML reads off, on, no and yes as truth values: put it in quotes)",
        ),
        ("name", None, "toy name = None: give text"),
    ],
)  # fmt: skip
def test_a_refusal_names_key_value_limit_and_remedy(field: str, value: Any, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        Toy(**{field: value})
    assert str(caught.value) == message


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
)


@given(st.sampled_from(sorted(settings_of(Toy))), anything)
def test_whatever_comes_is_taken_or_refused(field: str, value: Any) -> None:
    try:
        toy = Toy(**{field: value})
    except UsageError:
        return
    checked = getattr(toy, field)
    assert Toy(**{field: checked}) == toy
    hash(toy)


def test_an_unknown_key_is_refused_with_the_nearest_known_one() -> None:
    with pytest.raises(UsageError, match=r"^unknown toy key 'sise' \(did you mean 'size'\?\); known: size, share,"):
        require_known(["share", "sise"], settings_of(Toy), "toy key")
    with pytest.raises(UsageError, match=r"^unknown toy key 7; known"):
        require_known([7], settings_of(Toy), "toy key")


def test_a_long_key_costs_no_more_than_a_short_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a comparison grows with the length: 60 kB took 10 ms of the server's only thread."""
    compared: list[str] = []

    def compare(key: str, known: list[str], n: int, cutoff: float) -> list[str]:
        compared.append(key)
        return difflib.get_close_matches(key, known, n, cutoff)

    monkeypatch.setattr("v2v_protocol.settings.difflib", SimpleNamespace(get_close_matches=compare))
    for key in ("size" * 15_000, ["size"] * 15_000):
        with pytest.raises(UsageError, match=r"^unknown toy key"):
            require_known([key], settings_of(Toy), "toy key")
    assert [len(key) <= 200 for key in compared] == [True, True]


def test_a_message_shows_no_page_of_a_value() -> None:
    assert len(format_value("x" * 10_000)) < 300
    assert format_value((0.1, 1e-6)) == "[0.1, 1e-06]"


class Index:
    def __repr__(self) -> str:
        return "Index()"  # its id in each process of a run

    def __index__(self) -> int:
        return 2


WHOLE = [np.int64(2), np.uint8(2), np.array(2), torch.tensor(2), torch.tensor(2, dtype=torch.uint8), Index()]
REAL = [np.float32(0.25), np.float64(0.25), np.array(0.25), torch.tensor(0.25), Fraction(1, 4), "0.25"]
NEITHER = [
    np.bool_(True),
    torch.tensor(True),
    np.array([2, 2, 2]),
    np.array([]),
    None,
    1j,
    Decimal("0.25"),
    b"2",
    [[2]],
]


@pytest.mark.parametrize("value", WHOLE, ids=repr)
def test_whole_numbers_of_every_type_are_taken_as_pythons(value: Any) -> None:
    taken = Toy(size=value).size, require_whole("x", value, 0, 9), Setting("bounds", (1, 1), "", 1, 9).check("x", value)
    assert taken == (2, 2, (2, 2))
    assert {type(taken[0]), type(taken[1]), *map(type, taken[2])} == {int}


@pytest.mark.parametrize("value", REAL, ids=repr)
def test_numbers_of_every_type_are_taken_as_pythons(value: Any) -> None:
    taken = Toy(share=value).share
    assert (type(taken), taken) == (float, 0.25)
    assert Toy(corner=[value if float(value) > 0.5 else 1, 2]).corner == (1.0, 2.0)


def test_arrays_are_ranges_and_numpy_has_truth_values() -> None:
    toy = Toy(corner=np.array([0.5, 2], np.float32), is_on=np.bool_(True))  # type: ignore[arg-type]
    assert (toy.corner, toy.is_on) == ((0.5, 2.0), True)


@pytest.mark.parametrize("value", NEITHER, ids=repr)
def test_what_is_no_number_is_refused(value: Any) -> None:
    for field in ("size", "share"):
        with pytest.raises(RecipeError, match=f"toy {field} = "):
            Toy(**{field: value})
    with pytest.raises(UsageError, match="x = "):
        require_whole("x", value, 0, 9)
