"""What holds for every kind of video, one that a later file adds included."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import KINDS, VIDEOS, kind_from, kind_of

TEXTS = {"marks": "20000events"}
"""A value of each flag that is a text."""
PATHS = ["a.mp4", "b/c.MKV", "d/0001.png", "e.tiff", "f.zip", "g/h.txt", "i", "j.masks/0.png", "k.h5.v2ve"]


@st.composite
def stated(draw: st.DrawFn, kind: VideosKind) -> VideosKind:
    """Return the kind with any flags that it allows."""
    given_flags: dict[str, Any] = {"videos_kind": kind.name}
    for name, setting in kind.settings.items():
        if setting.kind == "text":  # which excludes the others
            if draw(st.booleans()):
                return kind_from({"videos_kind": kind.name, name: TEXTS[name]})
            continue
        wholes = st.integers(max(1, int(setting.low)), min(300, int(setting.high)))
        given_flags[name] = draw(st.just(setting.default) | wholes)
    return kind_from(given_flags)


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
@given(data=st.data())
def test_another_process_gets_the_kind_with_its_flags(kind: VideosKind, data: st.DataObject) -> None:
    one = data.draw(stated(kind))
    assert kind_from(one.flags) == one
    assert kind_from({"videos_kind": kind.name, "recipe": "paper", **dict.fromkeys(kind.settings)}) == kind


@pytest.mark.parametrize(("name", "flag"), [(kind.name, flag) for kind in KINDS.values() for flag in kind.settings])
def test_each_flag_makes_the_index_probe_again(name: str, flag: str) -> None:
    kind, setting = KINDS[name], KINDS[name].settings[flag]
    value = {"whole": 12, "number": 7.0, "text": TEXTS.get(flag)}[setting.kind]
    changed = kind_from({"videos_kind": name, flag: value})
    assert changed.mark(changed.rate_of(None)) != kind.mark(kind.rate_of(None))
    assert 0 <= changed.mark(changed.rate_of(None)) < 2**62


@pytest.mark.parametrize(("name", "flag"), [(kind.name, flag) for kind in KINDS.values() for flag in kind.settings])
def test_a_flag_of_another_kind_is_refused(name: str, flag: str) -> None:
    having = [kind.name for kind in KINDS.values() if flag in kind.settings]
    for other in KINDS.keys() - set(having):
        value = TEXTS.get(flag, 9)
        needed = f"--videos-kind {' or '.join(having)} .now {other}."
        words = f"--{flag.replace('_', '-')} {value}.* has no effect without {needed}"
        with pytest.raises(UsageError, match=words):
            kind_from({"videos_kind": other, flag: value})
        assert kind_from({"videos_kind": other, flag: KINDS[name].settings[flag].default}) == KINDS[other]


@pytest.mark.parametrize("path", PATHS)
def test_an_id_belongs_to_one_kind(path: str) -> None:
    """Each kind owns the ids that it gives; the first one owns all that none gives."""
    given_ids = {kind.id_of(path): kind for kind in KINDS.values()}
    for id, kind in given_ids.items():
        assert kind_of(id) == (kind if id else VIDEOS)
    endings = [ending for kind in KINDS.values() for ending in kind.endings]
    assert len(endings) == len(set(endings))
    assert endings == [ending.lower() for ending in endings]
