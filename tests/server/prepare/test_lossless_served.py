"""A prepared folder is its source: the same digest, the same positions, and the same samples to the last byte."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clips import damaged, panned_luma, write_clip
from tests.oracles.leases import open_leases, whole_sample
from tests.server.prepare.test_prepare import opened, run
from v2v_protocol.errors import CorpusError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.corpus_words import notes_of
from v2v_server.schedule import SequenceTable
from v2v_server.video.fingerprint import check_fingerprint, fingerprint
from v2v_server.video.rows import Rows
from v2v_tools.remake import remake

ROWS = "top:0.9"
SMALL = Recipe(voxels_per_clip=2, bins=3, crop_height_px=24, crop_width_px=32)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(source, store): rotated, 10 bit, 4:4:4, odd sizes, varying rate, full range, without time stamps, damaged."""
    folder = tmp_path_factory.mktemp("lossless")
    source = folder / "source"
    write_clip(source / "a.mp4", panned_luma(75, 90, 70), b_frames=2)
    write_clip(source / "b.webm", panned_luma(30, 96, 81), codec="libvpx-vp9")
    odd = panned_luma(33, 49, 63)
    write_clip(source / "sub" / "c.avi", odd, codec="mjpeg", pixel_format="yuvj420p", full_range=True)
    write_clip(source / "turned.mov", panned_luma(31, 48, 96), rotation_degrees=90)
    write_clip(source / "ten.mp4", panned_luma(20).astype(np.uint16) * 4, pixel_format="yuv420p10le")
    write_clip(source / "444.mp4", panned_luma(20), pixel_format="yuv444p")
    stamps = (np.arange(30) * 33 + np.arange(30) % 4 * 3 + 500).tolist()
    write_clip(source / "varying.mkv", panned_luma(30), pts=stamps)
    write_clip(source / "untimed.h264", panned_luma(20), rate=50, b_frames=2)
    write_clip(source / "small.mp4", panned_luma(20, 16, 16))
    assert run(source, folder / "store", rows=ROWS).complete
    return source, folder / "store"


def samples(root: Path, rows: str, spec: StreamSpec, arrays: tuple[str, ...], count: int) -> Iterator[Sample]:
    with open_leases(root, rows, spec) as (folder, leases):
        for lease in islice(leases, count):
            yield whole_sample(replace(lease, arrays=arrays), folder)


def require_equal(store: Sample, source: Sample, where: str) -> None:
    assert store.provenance.decoder == f"{source.provenance.decoder}, from the {where}"
    as_dict: dict[str, Any] = source.provenance.to_dict()
    assert store.provenance.to_dict() == as_dict | {"decoder": store.provenance.decoder}
    assert store.arrays.keys() == source.arrays.keys()
    for name, array in source.arrays.items():
        np.testing.assert_array_equal(store.arrays[name], array, strict=True, err_msg=name)


@pytest.mark.parametrize(
    "changes", [{}, {"frame_stride": 2, "resize_scale": (0.9, 1.2)}, {"voxel_seconds": (0.04, 0.2)}]
)
def test_samples_are_those_of_the_source(
    pair: tuple[Path, Path], changes: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path))
    spec = StreamSpec(recipe=SMALL.replace(**changes))
    arrays = ("voxels", "frames")
    both = zip(samples(pair[1], "full", spec, arrays, 40), samples(pair[0], ROWS, spec, arrays, 40), strict=True)
    videos = set()
    for store, source in both:
        require_equal(store, source, "store")
        videos.add(source.provenance.video)
    assert len(videos) == (7 if "voxel_seconds" in changes else 8)  # one has no frame rate


def test_same_digests(pair: tuple[Path, Path], tmp_path: Path) -> None:
    with (
        closing(open_catalogue(pair[0], rows=Rows.parse(ROWS), cache_dir=tmp_path, processes=0, scene=True)) as source,
        closing(open_catalogue(pair[1], cache_dir=tmp_path, processes=0, scene=True)) as store,
    ):
        assert (store.digest, store.scene_digest, store.rows) == (source.digest, source.scene_digest, source.rows)
        assert store.prepared is not None
        assert store.prepared.source_digest == source.digest
        for video in source.videos:
            assert store.frame_index(video.id).to_bytes() == source.frame_index(video.id).to_bytes()
            assert store.scene(video.id).to_bytes() == source.scene(video.id).to_bytes()


def test_a_store_of_whole_pictures_takes_any_rows(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """The scenes in its manifest are those of whole pictures: of other rows they are found again."""
    run(pair[0], tmp_path / "store", scene=True)
    for rows in ("full", "0.2:0.8"):
        opened = [open_catalogue(at, rows=Rows.parse(rows), cache_dir=tmp_path, processes=0, scene=True)
                  for at in (pair[0], tmp_path / "store")]  # fmt: skip
        assert opened[0].digest == opened[1].digest
        assert opened[0].scene_digest == opened[1].scene_digest
        for catalogue in opened:
            catalogue.close()
    with pytest.raises(CorpusError, match=r"rows top:0.5 asked for, but this prepared folder holds rows top:0.9"):
        open_catalogue(pair[1], rows=Rows.parse("top:0.5"), cache_dir=tmp_path, processes=0)


def test_rows_that_a_picture_has_not_change_no_digest(pair: tuple[Path, Path], tmp_path: Path) -> None:
    report = run(pair[0], tmp_path / "store", rows="top:60px")
    assert {video.id for video in report.failed} > {"444.mp4", "small.mp4"}
    with (
        closing(open_catalogue(pair[0], rows=Rows.parse("top:60px"), cache_dir=tmp_path, processes=0)) as source,
        closing(open_catalogue(tmp_path / "store", cache_dir=tmp_path, processes=0)) as store,
    ):
        assert store.digest == source.digest


def test_a_damaged_file_keeps_its_place(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """Its samples are made of the next candidate; a file of the store by itself is no video."""
    store = tmp_path / "store"
    shutil.copytree(pair[1], store)
    content = bytearray((store / "a.mp4").read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    (store / "a.mp4").write_bytes(content)
    spec = StreamSpec(recipe=SMALL, shuffle=False)
    with closing(open_catalogue(store, cache_dir=tmp_path, processes=0)) as damaged:
        refusals = [
            refusal
            for index in range(20)
            for refusal in remake(damaged, spec, seed=0, epoch=0, index=index).provenance.refusals
        ]
    assert {refusal.video for refusal in refusals} == {"a.mp4"}
    assert all("the store file is corrupt" in refusal.reason for refusal in refusals)
    (tmp_path / "plain").mkdir()
    shutil.copy(pair[1] / "444.mp4", tmp_path / "plain")
    with pytest.raises(CorpusError, match="is one file of a lossless corpus: serve the whole folder"):
        open_catalogue(tmp_path / "plain", cache_dir=tmp_path, processes=0)


# --- a folder of which a video failed ---------------------------------------------------------------------------------

BAND = "top:0.54"
WINDOWS = StreamSpec(recipe=Recipe(voxels_per_clip=2, bins=3, crop_height_px=24, crop_width_px=32))
"""Needs 7 frames."""
CORRUPT = "c.mp4"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(source, prepared): five clips, of which one is damaged in the middle."""
    folder = tmp_path_factory.mktemp("small")
    source = folder / "source"
    write_clip(source / "a.mp4", panned_luma(40, 90, 64), b_frames=2)
    write_clip(source / "b.webm", panned_luma(30, 96, 81), codec="libvpx-vp9")
    write_clip(source / "sub" / "d.avi", panned_luma(23, 99, 65), codec="mpeg4")
    write_clip(source / "e.mov", panned_luma(31, 48, 96), rotation_degrees=90)
    write_clip(folder / "whole.mp4", panned_luma(50, 90, 64), gop=50)
    damaged(folder / "whole.mp4", source / CORRUPT, 25)
    run(source, folder / "prepared", rows=BAND)
    return source, folder / "prepared"


@pytest.fixture
def copied(small: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the prepared folder that may be spoilt."""
    shutil.copytree(small[1], tmp_path / "prepared")
    return tmp_path / "prepared"


@pytest.fixture
def catalogues(small: tuple[Path, Path], tmp_path: Path) -> Iterator[tuple[Catalogue, Catalogue]]:
    source = open_catalogue(small[0], rows=Rows.parse(BAND), cache_dir=tmp_path, processes=0)
    with closing(source), closing(open_catalogue(small[1], cache_dir=tmp_path, processes=0)) as prepared:
        yield source, prepared


def sequences(catalogue: Catalogue) -> list[tuple[str, int]]:
    table = SequenceTable(catalogue.videos, catalogue.rows, WINDOWS)
    return [(table[rank].video.id, table[rank].start_frame) for rank in range(table.count)]


def test_same_ids_sequences_and_digest(catalogues: tuple[Catalogue, Catalogue]) -> None:
    source, prepared = catalogues
    assert [(v.id, v.frames, v.frames_per_second) for v in prepared.videos] == [
        (v.id, v.frames, v.frames_per_second) for v in source.videos
    ]
    assert sequences(prepared) == sequences(source)
    assert prepared.digest == source.digest
    assert source.prepared is None
    video = next(video for video in prepared.videos if video.id == CORRUPT)  # it failed: its place is kept but refused
    assert len(prepared.frame_index(CORRUPT)) == video.frames == 50
    with pytest.raises(VideoError):
        check_fingerprint(prepared.path(CORRUPT), video.fingerprint)
    assert any(CORRUPT in note for note in notes_of(prepared))


def test_lists_of_the_source_hold(small: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("sub/d.avi 23 0.2 0.3\na.mp4 40 0.5\nmissing.mp4\n")
    before, after = (
        opened(folder, rows, tmp_path / "list.txt") for folder, rows in zip(small, (BAND, None), strict=True)
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
    assert "a.mp4: its file is missing or changed" in str(notes_of(spoilt))
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
    assert {opened(copied, rows).digest for rows in (None, "full", BAND)} == {before.digest}


def test_parts_and_wholes_of_a_prepared_folder_are_refused(copied: Path) -> None:
    with pytest.raises(CorpusError, match="lies in the prepared folder"):
        opened(copied / "sub")
    shutil.copytree(copied, copied.parent / "more" / "inner")
    write_clip(copied.parent / "more" / "plain.mp4", panned_luma(8))
    with pytest.raises(CorpusError, match="cannot be a part of another corpus"):
        opened(copied.parent / "more")
