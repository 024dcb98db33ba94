"""Records and videos in columns say what one object for each would say."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_server.corpus.index import columns
from v2v_server.corpus.index.columns import Records, Texts, joined, merged
from v2v_server.corpus.index.file import IndexRow
from v2v_server.corpus.index.runs import CutVideos
from v2v_server.corpus.videos import NO_THRESHOLDS, Thresholds, Videos
from v2v_server.video.rows import Rows

NAMES = sorted(f"{name}-{number}.mp4" for name in ("plain", "Größe", "日本", "𝄞", "a b") for number in range(40))


def row(name: str, number: int) -> IndexRow:
    problem = "is damaged" if number % 7 == 3 else None
    rate = None if number % 5 == 0 else 20.0 + number
    codec = ("h264", "vp9", "av1")[number % 3]
    return IndexRow(
        name, 0, 0, 0, f"{number}-{number:032x}", 9 + number, 64, 48 + number % 2, rate, codec, number % 4 == 0, problem
    )


ROWS = [row(name, number) for number, name in enumerate(NAMES)]


def plain(record: IndexRow) -> tuple[object, ...]:
    return tuple(getattr(record, name) for name in IndexRow.__slots__[:-1])


@pytest.fixture
def records(monkeypatch: pytest.MonkeyPatch) -> Records:
    monkeypatch.setattr(columns, "CHUNK", 16)
    found = Records()
    for start in range(0, len(ROWS), 30):
        found.extend([plain(record) for record in ROWS[start : start + 30]])
    return found


def test_records_are_what_was_put_in(records: Records) -> None:
    assert list(records) == ROWS
    assert records.ids.part(11, 60) == NAMES[11:60]
    assert [records.ids.find(name) for name in NAMES] == list(range(len(NAMES)))
    assert [records.ids.find(name) for name in ("", "b", "plain-7", "￿")] == [None] * 4


def test_a_changed_record_is_the_new_one_before_and_after_it_is_packed(records: Records) -> None:
    new = [replace(ROWS[place], fingerprint=f"neu-{'ö' * place}", frames=1, codec="new") for place in (0, 77, 199)]
    new[1] = replace(new[1], problem="now")
    new[2] = replace(new[2], problem=None, frames_per_second=None)
    expected = list(ROWS)
    for record, place in zip(new, (0, 77, 199), strict=True):
        records.change(place, record)
        expected[place] = record
    assert list(records) == expected
    records.fingerprints.settle()
    assert list(records) == expected


def test_packed_records_are_taken_in_whole_whatever_numbers_their_formats_had(records: Records) -> None:
    other = Records()
    other.append(replace(ROWS[0], codec="av1"))
    other.take_in(records.packed())
    assert list(other) == [replace(ROWS[0], codec="av1"), *ROWS]
    assert list(records.rows()) == [plain(record) for record in ROWS]


@given(asked=st.sets(st.sampled_from(NAMES)), known=st.sets(st.sampled_from(NAMES)), size=st.integers(1, 70))
def test_records_of_parts_are_those_of_one_row_after_the_other(asked: set[str], known: set[str], size: int) -> None:
    """Whole parts are taken over where all of them is asked for: that may not show."""
    ids, index = sorted(asked), [plain(replace(record, size_bytes=7)) for record in ROWS if record.id in known]
    parts = []
    for start in range(0, len(index), size):
        part = Records()
        part.extend(index[start : start + size])
        parts.append(part.packed())
    unasked: list[str] = []
    found = merged(ids, parts, unasked)
    assert unasked == sorted(known - asked)
    rows = {row[0]: row for row in index}
    missing = (-1, 0, 0, "", 0, 0, 0, None, "", 0, None)
    assert list(found.rows()) == [rows.get(id, (id, *missing)) for id in ids]


def test_texts_of_nothing() -> None:
    assert list(Texts()) == Texts().part(0, 0) == []
    with pytest.raises(IndexError):
        Texts()[0]


def test_what_the_index_has_is_joined_with_what_was_asked() -> None:
    index = iter([(name, 5, 0, 0, "f", 1, 1, 1, None, "c", 0, None) for name in ("a", "b", "d", "f")])
    unasked: list[str] = []
    found = list(joined(["b", "c", "d", "e"], index, unasked))
    assert [(name, size) for name, size, *_ in found] == [("b", 5), ("c", -1), ("d", 5), ("e", -1)]
    assert unasked == ["a", "f"]


@pytest.mark.parametrize("all_usable", [False, True])
def test_videos_are_the_usable_ones_and_have_the_digest_of_all_that_shapes_samples(
    records: Records, monkeypatch: pytest.MonkeyPatch, all_usable: bool
) -> None:
    monkeypatch.setattr("v2v_server.corpus.videos.CHUNK", 16)
    if all_usable:
        records.problems.clear()
    used = [place for place in range(len(ROWS)) if place not in records.problems]
    thresholds: dict[int, Thresholds] = {3: (0.2, 0.3), 50: (0.25, None)}
    videos = Videos(records, np.array(used), thresholds, CutVideos.of([(4, ()), (5, ((0, 3), (4, 9)))]))
    assert len(videos) == len(used) == (200 if all_usable else 171)
    assert [video.id for video in videos] == [NAMES[place] for place in used]
    assert [videos.find(NAMES[place]) for place in used] == list(range(len(used)))
    assert videos.find("none") is None
    assert all(videos.find(NAMES[place]) is None for place in records.problems)
    assert videos[-1] == videos[len(used) - 1]
    assert videos[:2] == (videos[0], videos[1])
    assert [videos[number].runs for number in (4, 5, 6)] == [(), ((0, 3), (4, 9)), ((0, videos[6].frames),)]
    sha = hashlib.sha256(f"v2v catalogue 2\n{Rows()}\n".encode())
    for number, place in enumerate(used):
        is_ = ROWS[place]
        rate = math.nan if is_.frames_per_second is None else is_.frames_per_second
        limits = thresholds.get(number, NO_THRESHOLDS)
        fields = is_.id, is_.fingerprint, is_.frames, is_.width_px, is_.height_px, rate, *limits
        sha.update("\0".join(map(str, fields)).encode() + b"\n")
    assert videos.digest(Rows()) == sha.hexdigest()[:32]
