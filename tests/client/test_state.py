"""A saved state is taken up as it was, or refused in words, whatever became of it."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.position import LoaderShare, ResumeState, StreamIdentity
from v2v_protocol.errors import StateMismatch, UsageError

STATE = ResumeState(
    StreamIdentity({"recipe": {"gamma": 2.2}}, "s" * 64, "c" * 64, 1, 100), 3, 1, 0, 40, 2, LoaderShare(0, 2, 4, 5), 7
).to_dict()
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(), inner))


def test_a_state_comes_back() -> None:
    assert ResumeState.from_dict(STATE).to_dict() == STATE


def test_only_a_stream_with_sidecars_pins_them() -> None:
    assert "sidecars" not in STATE
    with_sidecars = STATE | {"sidecars": "d" * 32}
    assert ResumeState.from_dict(with_sidecars).to_dict() == with_sidecars
    one, other = (ResumeState.from_dict(state).stream for state in (STATE, with_sidecars))
    assert one is not None
    assert other is not None
    with pytest.raises(StateMismatch, match=r"sidecars: the state has d+, the server has ;"):
        other.require_same(one, ours="the state", theirs="the server")


@given(st.dictionaries(st.sampled_from([*STATE, "more"]), VALUES), st.sets(st.sampled_from(list(STATE))))
def test_a_hostile_state_is_taken_or_refused_in_words(changed: dict[str, Any], missing: set[str]) -> None:
    state = {name: value for name, value in (STATE | changed).items() if name not in missing}
    with suppress(UsageError):
        assert ResumeState.from_dict(state).to_dict().keys() == STATE.keys()


@given(st.dictionaries(st.sampled_from(list(STATE["loader_worker"])) | st.text(), VALUES) | VALUES)
def test_a_hostile_share_is_taken_or_refused_in_words(share: object) -> None:
    with suppress(UsageError):
        ResumeState.from_dict(STATE | {"loader_worker": share})


@given(VALUES)
def test_what_is_no_state_is_refused(value: Any) -> None:
    with suppress(UsageError):
        ResumeState.from_dict(value)
        raise AssertionError(value)
