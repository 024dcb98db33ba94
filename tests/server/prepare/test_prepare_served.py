"""A prepared folder as a corpus: every position means the same frames as in its source."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.clips import damaged, panned_luma, write_clip
from tests.server.prepare.test_prepare import opened, run
from v2v_protocol.errors import CorpusError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.schedule import SequenceTable
from v2v_server.video.fingerprint import check_fingerprint, fingerprint
from v2v_server.video.rows import Rows

ROWS = "top:0.54"
SPEC = StreamSpec(recipe=Recipe(voxels_per_clip=2, bins=3, crop_height_px=24, crop_width_px=32))
"""Needs 7 frames."""
CORRUPT = "c.mp4"


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(source, prepared): five clips, of which one is damaged in the middle."""
    folder = tmp_path_factory.mktemp("pair")
    source = folder / "source"
    (source / "sub").mkdir(parents=True)
    write_clip(source / "a.mp4", panned_luma(40, 90, 64), b_frames=2)
    write_clip(source / "b.webm", panned_luma(30, 96, 81), codec="libvpx-vp9")
    write_clip(source / "sub" / "d.avi", panned_luma(23, 99, 65), codec="mpeg4")
    write_clip(source / "e.mov", panned_luma(31, 48, 96), rotation_degrees=90)
    write_clip(folder / "whole.mp4", panned_luma(50, 90, 64), gop=50)
    damaged(folder / "whole.mp4", source / CORRUPT, 25)
    run(source, folder / "prepared", rows=ROWS)
    return source, folder / "prepared"


@pytest.fixture
def copied(pair: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the prepared folder that may be spoilt."""
    shutil.copytree(pair[1], tmp_path / "prepared")
    return tmp_path / "prepared"


@pytest.fixture
def catalogues(pair: tuple[Path, Path], tmp_path: Path) -> Iterator[tuple[Catalogue, Catalogue]]:
    source = open_catalogue(pair[0], rows=Rows.parse(ROWS), cache_dir=tmp_path, processes=0)
    with closing(source), closing(open_catalogue(pair[1], cache_dir=tmp_path, processes=0)) as prepared:
        yield source, prepared


def sequences(catalogue: Catalogue) -> list[tuple[str, int]]:
    table = SequenceTable(catalogue.videos, catalogue.rows, SPEC)
    return [(table[rank].video.id, table[rank].start_frame) for rank in range(table.count)]


def test_same_ids_sequences_and_digest(catalogues: tuple[Catalogue, Catalogue]) -> None:
    source, prepared = catalogues
    assert [(v.id, v.frames, v.frames_per_second) for v in prepared.videos] == [
        (v.id, v.frames, v.frames_per_second) for v in source.videos
    ]
    assert sequences(prepared) == sequences(source)
    assert prepared.digest == source.digest
    assert prepared.prepared is not None
    assert prepared.prepared.source_digest == source.digest
    assert source.prepared is None
    video = next(video for video in prepared.videos if video.id == CORRUPT)  # it failed: its place is kept but refused
    assert len(prepared.frame_index(CORRUPT)) == video.frames == 50
    with pytest.raises(VideoError):
        check_fingerprint(prepared.path(CORRUPT), video.fingerprint)
    assert any(CORRUPT in note for note in prepared.notes)


def test_rows_asked_for(pair: tuple[Path, Path]) -> None:
    plain = opened(pair[1])
    assert opened(pair[1], "full").digest == opened(pair[1], ROWS).digest == plain.digest


def test_lists_of_the_source_hold(pair: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("sub/d.avi 23 0.2 0.3\na.mp4 40 0.5\nmissing.mp4\n")
    before, after = (
        opened(folder, rows, tmp_path / "list.txt") for folder, rows in zip(pair, (ROWS, None), strict=True)
    )
    assert [(v.id, v.threshold_pos, v.threshold_neg) for v in after.videos] == [
        ("a.mp4", 0.5, 0.5), ("sub/d.avi", 0.2, 0.3),
    ]  # fmt: skip
    assert sequences(after) == sequences(before)
    assert (
        [refusal.video for refusal in after.refusals]
        == [refusal.video for refusal in before.refusals]
        == ["missing.mp4"]
    )


def test_a_missing_or_changed_file_keeps_its_place(copied: Path) -> None:
    whole = opened(copied)
    (copied / "a.mp4").unlink()
    (copied / "b.webm").write_bytes((copied / "e.mov").read_bytes())
    spoilt = opened(copied)
    assert sequences(spoilt) == sequences(whole)
    assert "a.mp4: its file is missing or changed" in str(spoilt.notes)
    for video in spoilt.videos[:2]:
        with pytest.raises(VideoError):
            check_fingerprint(copied / video.id, video.fingerprint)
    for path in copied.rglob("*.*"):
        if path.name != MANIFEST_NAME and path.is_file():
            path.unlink()
    with pytest.raises(CorpusError, match="none of 5 prepared files"):
        opened(copied)


def test_an_index_of_an_earlier_release_is_read_again(copied: Path) -> None:
    """It named a prepared file by its own bytes, not by its source."""
    whole = opened(copied)
    index = index_path(copied, copied.parent / "cache")
    with closing(sqlite3.connect(index)) as database, database:
        for video in whole.videos:
            if video.id != CORRUPT:
                named = fingerprint(copied / video.id), "v2v store", video.id
                database.execute("UPDATE video SET fingerprint = ?, codec = ? WHERE id = ?", named)
    again = opened(copied)
    assert (again.digest, again.notes) == (whole.digest, whole.notes)
    assert again.videos == whole.videos


def test_files_that_the_manifest_does_not_know(copied: Path) -> None:
    before = opened(copied)
    shutil.copy(copied / "a.mp4", copied / "stray.mp4")
    assert opened(copied).digest == before.digest


def test_parts_and_wholes_of_a_prepared_folder_are_refused(copied: Path) -> None:
    with pytest.raises(CorpusError, match="lies in the prepared folder"):
        opened(copied / "sub")
    shutil.copytree(copied, copied.parent / "more" / "inner")
    write_clip(copied.parent / "more" / "plain.mp4", panned_luma(8))
    with pytest.raises(CorpusError, match="cannot be a part of another corpus"):
        opened(copied.parent / "more")
