"""Preparing a corpus: what the files hold, what the manifest says, what is refused."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from contextlib import closing, suppress
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tests.clips import damaged, panned_luma, write_clip
from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import CorpusError, UsageError
from v2v_server.commands.prepare import main as prepare_main
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.probe import facts_of
from v2v_server.corpus.sources.prepared import read_manifest
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.prepare import Report, prepare
from v2v_server.store.store_file import StoreFile
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.probe import probe
from v2v_server.video.rows import Rows

CORRUPT = "dir/corrupt.mp4"


def whole(path: Path) -> npt.NDArray[np.uint8]:
    facts = probe(path)
    return decode_luma(path, facts.index, 0, facts.frames).frames


def stored_whole(path: Path) -> npt.NDArray[np.uint8]:
    with StoreFile(path) as stored:
        head = stored.head
        cut = Cut(head.count, (head.top, 0, head.rows, head.width_px))
        return np.stack([each.grey for each in stored.pictures(ClipRequest(stored.facts().index, 0, (cut,)))])


def run(
    source: Path,
    target: Path,
    rows: str = "full",
    list_file: Path | None = None,
    **more: object,
) -> Report:
    catalogue = open_catalogue(
        source, list_file=list_file, rows=Rows.parse(rows), cache_dir=source.parent / "cache", processes=0
    )
    with closing(catalogue):
        return prepare(catalogue, target, **({"processes": 0} | more))  # type: ignore[arg-type]


def opened(folder: Path, rows: str | None = None, list_file: Path | None = None) -> Catalogue:
    """A catalogue of a folder, closed: what it knows stays."""
    parsed = None if rows is None else Rows.parse(rows)
    catalogue = open_catalogue(folder, rows=parsed, list_file=list_file, cache_dir=folder.parent / "cache", processes=0)
    catalogue.close()
    return catalogue


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five clips of 64 px width: plain, odd size in AVI, rotated with varying rate, full range, and a damaged one."""
    folder = tmp_path_factory.mktemp("corpus") / "source"
    write_clip(folder / "b.mp4", panned_luma(40, 50, 64), b_frames=2)
    write_clip(
        folder / "dir" / "odd.avi", panned_luma(33, 49, 63), codec="mjpeg", pixel_format="yuvj420p", full_range=True
    )
    stamps = (np.arange(30) * 33 + np.arange(30) % 4 * 3 + 500).tolist()
    write_clip(folder / "a turned.mov", panned_luma(30, 64, 48), pts=stamps, rotation_degrees=90)
    write_clip(folder / "dir" / "pc.mkv", panned_luma(25, 48, 64), full_range=True, pixel_format="yuvj420p")
    write_clip(folder.parent / "whole.mp4", panned_luma(30), gop=30)
    damaged(folder.parent / "whole.mp4", folder / CORRUPT, 12)
    return folder


@pytest.fixture(scope="module")
def prepared(source: Path) -> tuple[Path, Report]:
    target = source.parent / "prepared"
    return target, run(source, target, rows="top:0.54")


def snapshot(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.stat().st_ino, p.read_bytes()) for p in files}


def test_files_hold_the_rows_of_the_source_and_a_corrupt_one_is_listed(
    source: Path, prepared: tuple[Path, Report]
) -> None:
    target, report = prepared
    assert [video.id for video in report.prepared] == ["a turned.mov", "b.mp4", "dir/odd.avi", "dir/pc.mkv"]
    for video in report.prepared:
        before, after = probe(source / video.id), facts_of(target / video.id)
        assert (after.frames, after.height_px, after.width_px) == (before.frames, before.height_px, before.width_px)
        np.testing.assert_array_equal(
            after.index.seconds(0, after.frames), before.index.seconds(0, before.frames), strict=True
        )
        rows = int(before.height_px * 0.54)
        np.testing.assert_array_equal(stored_whole(target / video.id), whole(source / video.id)[:, :rows])
        sizes = (source / video.id).stat().st_size, (target / video.id).stat().st_size
        assert (video.source_bytes, video.bytes) == sizes
    (failed,) = report.failed
    assert (failed.id, "frame" in str(failed.problem), report.complete) == (CORRUPT, True, False)
    assert sorted(path.name for path in target.rglob("*.*")) == [
        ".v2v-prepare.lock", "a turned.mov", "b.mp4", "odd.avi", "pc.mkv", MANIFEST_NAME,
    ]  # fmt: skip
    manifest = read_manifest(target)
    assert (manifest.header.rows, manifest.header.size, manifest.header.videos) == ("top:0.54", "dense", 5)
    assert manifest.header.source_digest == opened(source, "top:0.54").digest
    assert manifest.videos == {video.id: video for video in report.videos}


@pytest.fixture
def two(source: Path, tmp_path: Path) -> Path:
    """A folder with x.mp4 and y.mp4."""
    (tmp_path / "source").mkdir()
    for name in ("x.mp4", "y.mp4"):
        shutil.copy(source / "b.mp4", tmp_path / "source" / name)
    return tmp_path / "source"


def test_a_video_that_cannot_be_written_fails_alone(two: Path, tmp_path: Path) -> None:
    """Where the file should be, there is a folder."""
    run(two, tmp_path / "out")
    (tmp_path / "out" / "x.mp4").unlink()
    (tmp_path / "out" / "x.mp4").mkdir()
    (tmp_path / "out" / "x.mp4" / "in the way").touch()
    report = run(two, tmp_path / "out")
    assert [video.id for video in report.failed] == ["x.mp4"]
    assert [video.id for video in report.prepared] == ["y.mp4"]


def test_a_source_that_is_waited_for_in_vain_fails_alone(
    two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v2v_server.prepare._deadline_seconds", lambda job: {"x.mp4": 0.1}.get(job.video.id, 60))
    with closing(open_catalogue(two, cache_dir=tmp_path / "cache", processes=0)) as catalogue:
        (two / "x.mp4").unlink()
        os.mkfifo(two / "x.mp4")
        report = prepare(catalogue, tmp_path / "out", processes=1)
    assert [(video.id, video.problem) for video in report.failed] == [
        ("x.mp4", "hangs the transcoder: ended after 0 s without a result")
    ]
    assert [video.id for video in report.prepared] == ["y.mp4"]


def test_refused_places(source: Path, prepared: tuple[Path, Report], tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    shutil.copy(source / "b.mp4", corpus)
    for target in (corpus, corpus / "inside", tmp_path):
        with pytest.raises(CorpusError, match="overlap; choose a destination outside the source"):
            run(corpus, target)
    (tmp_path / "alias").symlink_to(corpus)
    with pytest.raises(CorpusError, match="overlap; choose a destination outside the source"):
        run(corpus, tmp_path / "alias" / "inside")
    assert sorted(path.name for path in corpus.rglob("*")) == ["b.mp4"]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "b.mp4").write_bytes(b"precious")
    with pytest.raises(CorpusError, match="no manifest"):
        run(corpus, tmp_path / "foreign")
    assert (tmp_path / "foreign" / "b.mp4").read_bytes() == b"precious"
    with pytest.raises(CorpusError, match="prepared folder itself"):
        run(prepared[0], tmp_path / "twice")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "b.mp4").symlink_to(corpus / "b.mp4")
    with pytest.raises(CorpusError, match="is a link into it"):
        run(tmp_path / "linked", corpus)


def test_one_video_may_be_prepared_in_its_own_folder(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    films = tmp_path / "films"
    films.mkdir()
    shutil.copy(source / "b.mp4", films)
    shutil.copy(source / "b.mp4", films / "other.mp4")
    more = ["--workers", "1", "--cache-dir", str(tmp_path / "cache")]
    prepare_main([str(films / "b.mp4"), str(films / "prepared"), *more])
    assert "1 of 1 videos prepared" in capsys.readouterr().out
    assert [video.id for video in opened(films / "prepared").videos] == ["b.mp4"]
    before = snapshot(films)
    (films / "list.txt").write_text("b.mp4\n")
    for place, target in ((films / "b.mp4", films), (films / "b.mp4", tmp_path), (films / "list.txt", films / "more")):
        assert prepare_main([str(place), str(target), *more]) == 2
        assert "overlap; choose a destination outside the source" in capsys.readouterr().err
    (films / "list.txt").unlink()
    assert snapshot(films) == before
    with pytest.raises(CorpusError, match="prepared is a prepared folder"):  # and the whole is no corpus unnoticed
        opened(films)


def test_labels_that_are_left_behind_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_clip(tmp_path / "films" / "a.mp4", panned_luma(12))
    (tmp_path / "films" / "a.boxes.txt").write_text("1,1,2,3,4,5\n")
    place = tmp_path / "store"
    more = ["--workers", "1", "--cache-dir", str(tmp_path / "cache")]
    assert prepare_main([str(tmp_path / "films"), str(place), *more]) == 0
    said = capsys.readouterr().out
    assert "1 sidecars .boxes.txt (labels) were left beside their videos: copy them to the same places in" in said
    assert not (place / "a.boxes.txt").exists()


def test_the_table_has_every_flag(capsys: pytest.CaptureFixture[str]) -> None:
    assert prepare_main(["--help"]) == 0
    flags = set(re.findall(r"--[a-z-]+", capsys.readouterr().out.partition("General:")[0]))
    table = (Path(__file__).parents[3] / "docs" / "prepare.md").read_text()
    assert {flag for flag in flags if f"| `{flag}` |" not in table} == set()


def test_a_link_in_the_destination_is_not_followed(source: Path, tmp_path: Path) -> None:
    shutil.copytree(source / "dir", tmp_path / "source" / "dir")
    write_clip(tmp_path / "source" / f"{'n' * 250}.mp4", panned_luma(8))
    (tmp_path / "source" / "b.mp4").write_bytes((source / "b.mp4").read_bytes())
    run(tmp_path / "source", tmp_path / "out")
    shutil.rmtree(tmp_path / "out" / "dir")
    (tmp_path / "out" / "dir").symlink_to(tmp_path / "source" / "dir")
    before = snapshot(tmp_path / "source")
    report = run(tmp_path / "source", tmp_path / "out")
    assert snapshot(tmp_path / "source") == before
    assert {video.id for video in report.prepared} == {"b.mp4", f"{'n' * 250}.mp4"}


def test_other_settings_need_another_folder(source: Path, prepared: tuple[Path, Report]) -> None:
    for size, rows in (("fast", "top:0.54"), ("dense", "full")):
        with pytest.raises(
            CorpusError,
            match=r"holds 4 videos prepared with .* is requested; choose another folder, or delete",
        ):
            run(source, prepared[0], rows, size=size)
    with pytest.raises(UsageError, match="size 'tiny': choose one of dense, fast, raw"):
        run(source, prepared[0], size="tiny")


def test_a_folder_of_lossy_files_is_refused_with_the_remedy(prepared: tuple[Path, Report], tmp_path: Path) -> None:
    """As an earlier release wrote it."""
    header, *lines = map(json.loads, (prepared[0] / MANIFEST_NAME).read_text().splitlines())
    header |= {"codec": "h264", "size": "", "quality": 18, "gop": 25}
    lines = [line | {"psnr_db": 41.5, "worst_psnr_db": 40.1} for line in lines]
    (tmp_path / MANIFEST_NAME).write_text("".join(json.dumps(each) + "\n" for each in (header, *lines)))
    with pytest.raises(
        CorpusError,
        match=r"prepared with --codec 'h264', which this release does not serve: re-encode the videos with ffmpeg, and "
        "serve them as videos$",
    ):
        read_manifest(tmp_path)
    header |= {"codec": "lossless", "size": "dense", "quality": 0, "gop": 0}
    (tmp_path / MANIFEST_NAME).write_text("".join(json.dumps(each) + "\n" for each in (header, *lines)))
    assert read_manifest(tmp_path).videos == read_manifest(prepared[0]).videos


def test_a_manifest_that_makes_no_sense(prepared: tuple[Path, Report], tmp_path: Path) -> None:
    header, *lines = (prepared[0] / MANIFEST_NAME).read_text().splitlines()
    video = json.loads(lines[0])
    for text, complaint in (
        ("", "no whole line"),
        ("nonsense\n", "line 1"),
        (json.dumps(json.loads(header) | {"version": 1}) + "\n", "version 1"),
        (f"{header}\n{json.dumps(video | {'id': '../x.mp4'})}\n", "line 2.*leads out"),
        (
            f"{header}\n{json.dumps(video | {'frames': 0})}\n",
            r"line 2: PreparedVideo.frames = 0: expected .* from 1 to",
        ),
        (f"{json.dumps(json.loads(header) | {'size': 'tiny'})}\n", r"line 1: Header: size 'tiny': this .* reads dense"),
    ):
        (tmp_path / MANIFEST_NAME).write_text(text)
        with pytest.raises(CorpusError, match=complaint):
            read_manifest(tmp_path)
    values = (None, True, 0, -1, 1 << 70, 0.5, float("nan"), float("inf"), "", "\0\ud800/..", [], [1], {})
    for line, field, value in product((0, 1), json.loads(header) | video, values):
        written = [json.loads(header), dict(video)]
        written[line][field] = value
        (tmp_path / MANIFEST_NAME).write_text("".join(json.dumps(each) + "\n" for each in written))
        with suppress(CorpusError):  # any value is taken or refused in words
            read_manifest(tmp_path)
    (tmp_path / MANIFEST_NAME).write_text(f"{header}\n{lines[0]}\n{lines[1][:20]}")
    assert list(read_manifest(tmp_path).videos) == [video["id"]]


def test_one_run_at_a_time(source: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with (tmp_path / "out" / ".v2v-prepare.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(CorpusError, match="another v2v-prepare"):
            run(source, tmp_path / "out")
    assert os.listdir(tmp_path / "out") == [".v2v-prepare.lock"]
