"""The table of videos and the snapshot's videos say what one object for each would say."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.pieces import pieces, shots
from v2v_server.corpus import videos as videos_module
from v2v_server.corpus.index import columns
from v2v_server.corpus.index.columns import StringColumn, VideoTable, joined
from v2v_server.corpus.index.file import IndexRow
from v2v_server.corpus.scenes.scene import Flag, SplitVideos
from v2v_server.corpus.videos import NO_THRESHOLDS, Thresholds, Videos
from v2v_server.video.rows import Rows

NAMES = sorted(f"{name}-{number}.mp4" for name in ("plain", "Größe", "日本", "𝄞", "a b") for number in range(40))


def row(name: str, number: int) -> IndexRow:
    problem = "is damaged" if number % 7 == 3 else None
    rate = None if number % 5 == 0 else 20.0 + number
    codec = ("h264", "vp9", "av1")[number % 3]
    return IndexRow(
        name,
        -1,
        0,
        0,
        f"{number}-{number:032x}",
        9 + number,
        64,
        48 + number % 2,
        rate,
        codec,
        number % 4 == 0,
        problem,
    )


ROWS = [row(name, number) for number, name in enumerate(NAMES)]


def read(rows: Iterable[tuple[Any, ...]]) -> VideoTable:
    rows = [(*row, None) for row in rows]
    table, _ = VideoTable.read(rows, len(rows))
    return table


def rows_of(table: VideoTable) -> list[IndexRow]:
    return [table.row(at) for at in range(len(table))]


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> VideoTable:
    monkeypatch.setattr(columns, "CHUNK", 16)
    return read(record.columns for record in ROWS)


def test_a_table_holds_its_rows(table: VideoTable) -> None:
    assert rows_of(table) == ROWS
    assert list(table.ids) == NAMES
    assert table.ids[11:60] == NAMES[11:60]
    assert table.ids[60:11:-7] == NAMES[60:11:-7]
    assert [table.ids.find(name) for name in NAMES] == list(range(len(NAMES)))
    assert [table.ids.find(name) for name in ("", "b", "plain-7", "￿")] == [None] * 4
    with pytest.raises(IndexError, match="string 200 of 200"):
        table.ids[200]


def test_an_empty_table() -> None:
    table = read([])
    assert len(table) == len(table.ids) == 0
    assert list(table.ids) == table.ids[0:5] == []
    assert table.ids.find("a") is None


@settings(max_examples=25)
@given(st.lists(st.booleans(), min_size=len(NAMES), max_size=len(NAMES)))
def test_a_mask_selects_rows(mask: list[bool]) -> None:
    table = read(record.columns for record in ROWS)
    expected = [record for record, is_in in zip(ROWS, mask, strict=True) if is_in]
    assert rows_of(table.where(np.array(mask))) == expected


@given(st.sets(st.sampled_from(NAMES)), st.sets(st.sampled_from(NAMES)))
def test_rows_are_joined_with_the_ids_that_are_asked(asked: set[str], known: set[str]) -> None:
    ids, unasked = sorted(asked), list[str]()
    found = list(joined(ids, ((name, 5) for name in sorted(known)), unasked, (-1,)))
    assert found == [(id, 5 if id in known else -1) for id in ids]
    assert unasked == sorted(known - asked)


def test_an_id_without_a_row_has_to_be_probed() -> None:
    table, states = VideoTable.read(joined(["a"], [], []), 1)
    assert states.tolist() == [[-1, 0, 0]]
    assert table.problem[0] is not None


_INTEGERS = ["size_bytes", "mtime_ns", "ctime_ns", "frames", "width_px", "height_px", "interlaced"]


@pytest.mark.parametrize(
    ("column", "value"),
    [
        *((column, value) for column in _INTEGERS for value in ("x", b"x", 0.5, "", math.inf, None, 2**70)),
        *((column, value) for column in ("fingerprint", "codec") for value in (b"x", 0.5, None)),
        *(("problem", value) for value in (b"x", 0.5)),
        *((column, value) for column in ("frames", "width_px", "height_px") for value in (-5, 0, 2**40)),
        *(("frames_per_second", value) for value in ("x", b"x", math.inf, -1.0)),
        ("interlaced", 2),
    ],
)
def test_a_damaged_row_has_to_be_probed_and_harms_no_other(
    monkeypatch: pytest.MonkeyPatch, column: str, value: object
) -> None:
    """SQLite accepts any type in any column."""
    monkeypatch.setattr(columns, "CHUNK", 16)
    states = [[number, 10**18 + number, -number] for number in range(len(ROWS))]
    records = [
        replace(record, size_bytes=a, mtime_ns=b, ctime_ns=c) for record, (a, b, c) in zip(ROWS, states, strict=True)
    ]
    records[20] = replace(records[20], **{column: value})  # type: ignore[arg-type]
    states[20] = [-1, 0, 0]
    table, known = VideoTable.read(((*record.columns, None) for record in records), len(records))
    assert known.tolist() == states
    found = rows_of(table)
    assert found[20].id == NAMES[20]
    assert found[20].problem is not None
    assert found[:20] + found[21:] == ROWS[:20] + ROWS[21:]


def test_a_row_with_a_problem_needs_no_frames() -> None:
    unusable = IndexRow("a", -1, problem="is no video")
    assert rows_of(read([unusable.columns, ROWS[0].columns])) == [unusable, ROWS[0]]


def test_strings_are_one_piece_of_utf_8() -> None:
    column = StringColumn("aßc".encode(), np.array([1, 0, 3]))
    assert list(column) == ["a", "", "ßc"]
    assert [column[at] for at in range(3)] == list(column)


@pytest.mark.parametrize("all_usable", [False, True])
def test_videos_are_the_usable_ones_and_have_the_digest_of_all_that_shapes_samples(
    table: VideoTable, monkeypatch: pytest.MonkeyPatch, all_usable: bool
) -> None:
    monkeypatch.setattr(videos_module, "CHUNK", 16)
    used = [at for at, record in enumerate(ROWS) if all_usable or record.problem is None]
    thresholds: dict[int, Thresholds] = {3: (0.2, 0.3), 50: (0.25, None)}
    divided = {4: pieces((9, Flag.BLACK)).tobytes(), 5: shots(9, 4).tobytes()}
    table = table.where(np.isin(np.arange(len(ROWS)), used))
    each = [divided.get(number, b"") for number in range(len(table.frames))]
    videos = Videos(table, thresholds, SplitVideos.of(each))
    assert len(videos) == len(used) == (200 if all_usable else 171)
    assert [video.id for video in videos] == [NAMES[at] for at in used]
    assert [videos.fingerprints[number] for number in range(len(used))] == [ROWS[at].fingerprint for at in used]
    assert [videos.find(NAMES[at]) for at in used] == list(range(len(used)))
    assert videos.find("none") is None
    assert videos[-1] == videos[len(used) - 1]
    assert videos[:2] == (videos[0], videos[1])
    with pytest.raises(IndexError):
        videos[len(used)]
    assert [video.pieces for video in videos] == each
    sha = hashlib.sha256(f"v2v catalogue 2\n{Rows()}\n".encode())
    for number, at in enumerate(used):
        is_ = ROWS[at]
        rate = math.nan if is_.frames_per_second is None else is_.frames_per_second
        limits = thresholds.get(number, NO_THRESHOLDS)
        fields = is_.id, is_.fingerprint, is_.frames, is_.width_px, is_.height_px, rate, *limits
        sha.update("\0".join(map(str, fields)).encode() + b"\n")
    assert videos.digest(Rows()) == sha.hexdigest()[:32]
