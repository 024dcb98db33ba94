"""Preparing again: after nothing, after changes, after kill -9 at any moment."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from tests.clips import damaged, panned_luma, write_clip, write_panned
from tests.server.prepare.test_prepare import opened, run, stored_whole, whole
from tests.server.prepare.test_prepare_isolate import children
from tests.waiting import until
from v2v_protocol.errors import CorpusError, VideoError
from v2v_server.commands.prepare import main, summary
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources.prepared import read_manifest
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.prepare import PARTIAL_SUFFIX, Transcoding, find_standing, prepare, refuse_links
from v2v_server.store.store_file import StoreFile
from v2v_server.video.fingerprint import fingerprint

_KILLED_SECONDS = 60.0


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_panned(tmp_path_factory.mktemp("clips"), 4, 24)
    write_clip(folder / "sub" / "4.mp4", panned_luma(30))
    return folder


@pytest.fixture
def source(clips: Path, tmp_path: Path) -> Path:
    """Five clips that a test may change."""
    return Path(shutil.copytree(clips, tmp_path / "source"))


@pytest.fixture
def out(source: Path, tmp_path: Path) -> Path:
    """The source, prepared."""
    run(source, tmp_path / "out")
    return tmp_path / "out"


@pytest.fixture(autouse=True)
def _no_process_left() -> Iterator[None]:
    yield
    assert not psutil.wait_procs(children(), timeout=60)[1]


def is_whole(path: Path) -> bool:
    with StoreFile(path) as stored:
        return stored.is_whole


def inodes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_ino for path in folder.rglob("*.mp4")}


def test_a_run_on_a_part_forgets_nothing(source: Path, tmp_path: Path, out: Path) -> None:
    """Whether a list leaves the others out, or their folder is away that day."""
    first = run(source, out)
    before, digest = inodes(out), opened(out).digest
    (tmp_path / "part.txt").write_text("1.mp4\nsub/4.mp4\n")
    part = run(source, out, list_file=tmp_path / "part.txt")
    assert (part.kept, len(part.videos)) == (2, 2)
    served = opened(out)  # finished, and exactly what was asked for last
    assert [video.id for video in served.videos] == ["1.mp4", "sub/4.mp4"]
    (tmp_path / "other.txt").write_text("0.mp4\n1.mp4\n")
    assert "last v2v-prepare was not asked for it" in opened(out, list_file=tmp_path / "other.txt").refusals[0].reason
    (source / "sub").rename(tmp_path / "away")
    away = run(source, out)
    assert (away.kept, len(away.videos)) == (4, 4)
    (tmp_path / "away").rename(source / "sub")
    whole_again = run(source, out)
    assert whole_again.kept == 5
    assert whole_again.videos == first.videos
    assert inodes(out) == before
    assert opened(out).digest == digest


def test_another_corpus_is_not_taken_for_a_changed_source(source: Path, tmp_path: Path, out: Path) -> None:
    """Every video of the same name would be replaced."""
    before = inodes(out)
    other = tmp_path / "other"
    write_clip(other / "0.mp4", panned_luma(24, step=(2, 3)))
    with pytest.raises(CorpusError, match="folder called source, and none of its 5 videos is one of the 1 of other"):
        run(other, out)
    assert inodes(out) == before
    assert len(opened(out).videos) == 5

    # The same corpus under another name has something in common, and a source that keeps its name may change wholly.
    renamed = source.rename(tmp_path / "renamed")
    assert run(renamed, out).kept == 5
    shutil.rmtree(renamed)
    other.rename(renamed)
    assert (run(renamed, out).kept, len(opened(out).videos)) == (0, 1)


def test_finished_files_are_looked_at_together_and_told_of(
    source: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Waiting for one disk after the other, in silence, would look hung where there are many."""
    inside, several = [], threading.Event()

    def among_others(*file: Any) -> object:
        inside.append(file)
        if len(inside) > 1:
            several.set()
        assert several.wait(60.0), "the files are read one after the other"
        return find_standing(*file)

    monkeypatch.setattr("v2v_server.prepare.find_standing", among_others)
    steps: list[tuple[int, int]] = []
    assert run(source, out, progress=lambda *step: steps.append(step[:2])).kept == 5
    assert steps == [(0, 126), (24, 126), (48, 126), (72, 126), (96, 126), (126, 126)]


def test_a_source_with_links_into_the_destination_is_refused(source: Path, out: Path) -> None:
    shutil.copy(source / "0.mp4", out / "sub" / "plain.mp4")
    (source / "linked").symlink_to(out / "sub")
    with pytest.raises(CorpusError, match=r"linked/plain\.mp4 of the source is a link into it"):
        refuse_links(opened(source), out)


def test_a_prepared_file_that_cannot_be_read_is_not_given_up(
    source: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest, before = (out / MANIFEST_NAME).read_bytes(), inodes(out)

    def refuse(path: Path) -> StoreFile:
        if path.name == "3.mp4":
            raise VideoError(str(path), None, "cannot be read: Permission denied") from PermissionError(13, "denied")
        return StoreFile(path)

    monkeypatch.setattr("v2v_server.prepare.StoreFile", refuse)
    with pytest.raises(CorpusError, match=r"3\.mp4 cannot be read: Permission denied, .* nothing was changed"):
        run(source, out)
    assert (out / MANIFEST_NAME).read_bytes() == manifest
    assert inodes(out) == before


class _Stop(BaseException):
    pass


def test_what_is_cut_off_forgets_nothing(source: Path, out: Path) -> None:
    """Statistics are added to a finished folder, and the run ends after the first."""
    first = run(source, out)
    before = inodes(out)

    def stop_after_one(done: int, total: int, *sizes: int) -> None:
        if done:
            raise _Stop

    with pytest.raises(_Stop):
        run(source, out, scene=True, progress=stop_after_one)
    records = read_manifest(out).videos
    assert len(opened(out).videos) == 5
    assert sum(bool(record.scene) for record in records.values()) == 1
    assert [replace(record, scene="") for _, record in sorted(records.items())] == list(first.videos)
    last = run(source, out, scene=True)
    assert (last.kept, last.looked_at, last.complete) == (1, 4, True)
    assert "4 were prepared earlier; only statistics" in summary(last, "dense", 0.0)[1]
    assert run(source, out).kept == 5, "without them, what is there with them will do"
    assert inodes(out) == before


def test_a_finished_folder_with_a_failure_stays_finished_and_tries_it_again(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when a run that tries the failed one again is cut off."""
    out, sound = tmp_path / "out", write_clip(tmp_path / "sound.mp4", panned_luma(24), gop=24)
    damaged(sound, source / "0.mp4", 12)
    for _ in range(2):
        assert [video.id for video in run(source, out).failed] == ["0.mp4"]
    before = opened(out).digest

    def stop(job: Transcoding) -> None:
        raise _Stop

    with monkeypatch.context() as patch:
        patch.setattr("v2v_server.prepare.transcode", stop)
        with pytest.raises(_Stop):
            run(source, out)
    assert opened(out).digest == before
    shutil.copy(sound, source / "0.mp4")
    report = run(source, out)
    assert (report.kept, report.complete) == (4, True)


def test_a_look_that_fails_costs_no_prepared_file(source: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run(source, out)

    def refuse(job: Transcoding) -> None:
        raise VideoError(str(job.source), 3, "is damaged")

    monkeypatch.setattr("v2v_server.prepare.transcode", refuse)
    report = run(source, out, scene=True)
    assert report.videos == first.videos == tuple(video for _, video in sorted(read_manifest(out).videos.items()))
    assert [refusal.reason for refusal in report.not_looked_at] == ["frame 3: is damaged"] * 5
    assert not report.complete


def test_ctrl_c_says_that_the_same_command_goes_on(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("v2v_server.commands.prepare.prepare", interrupted)
    assert main([str(source), str(tmp_path / "out"), "--cache-dir", str(tmp_path / "cache"), "--workers", "1"]) == 130
    assert capsys.readouterr().err == "v2v-prepare: interrupted; run the same command to continue\n"


def test_a_file_that_is_cut_short_or_of_other_settings_is_written_again(
    source: Path, tmp_path: Path, out: Path
) -> None:
    whole_file = (out / "0.mp4").read_bytes()
    (out / "0.mp4").write_bytes(whole_file[:-1])
    run(source, tmp_path / "raw", size="raw")
    shutil.copy(tmp_path / "raw" / "1.mp4", out / "1.mp4")
    run(source, tmp_path / "rows", rows="top:0.5")
    shutil.copy(tmp_path / "rows" / "2.mp4", out / "2.mp4")
    shutil.copy(out / "sub" / "4.mp4", out / "3.mp4")
    assert run(source, out).kept == 1
    assert (out / "0.mp4").read_bytes() == whole_file
    assert run(source, out).kept == 5
    run(source, tmp_path / "colour", planes=("chroma",))
    with (tmp_path / "colour" / "0.mp4").open("r+b") as file:
        file.truncate(file.seek(0, os.SEEK_END) - 1)
    assert run(source, tmp_path / "colour").kept == 4
    assert run(source, tmp_path / "colour").kept == 5  # four of them have a plane that is not asked for


def test_a_folder_of_an_earlier_release_goes_on(source: Path, out: Path) -> None:
    """Its lines also had the fingerprint of the prepared file, and those of videos that were set aside."""
    report, before = run(source, out), inodes(out)
    header, *lines = map(json.loads, (out / MANIFEST_NAME).read_text().splitlines())
    lines = [line | {"fingerprint": fingerprint(out / line["id"])} for line in lines]
    (aside,) = (line for line in lines if line["id"] == "0.mp4")
    aside |= {"aside": True}
    header["videos"] = 4
    (out / MANIFEST_NAME).write_text("".join(json.dumps(each) + "\n" for each in (header, *lines)))
    assert [video.id for video in opened(out).videos] == ["1.mp4", "2.mp4", "3.mp4", "sub/4.mp4"]
    again = run(source, out)
    assert (again.kept, again.videos) == (5, report.videos)
    assert inodes(out) == before


def test_a_video_that_changes_after_the_start_fails_alone(source: Path, tmp_path: Path) -> None:
    with closing(open_catalogue(source, cache_dir=tmp_path / "cache", processes=0)) as catalogue:
        (source / "0.mp4").unlink()
        open_catalogue(source, cache_dir=tmp_path / "cache", processes=0).close()  # as another command does meanwhile
        report = prepare(catalogue, tmp_path / "out", processes=0)
    assert [(video.id, "has changed" in str(video.problem)) for video in report.failed] == [("0.mp4", True)]
    assert len(report.prepared) == 4


def _killed_in_the_middle(command: Sequence[str], cache: Path, out: Path, wanted: int) -> bool:
    """Runs a command that is killed while it writes a file and so many new ones are done; whether it was."""
    seen = set(inodes(out).values()) if out.exists() else set()

    def due() -> bool:
        there = list(out.rglob("*")) if out.exists() else []
        fresh = {path.stat().st_ino for path in there if path.suffix == ".mp4"} - seen
        return len(fresh) >= wanted and any(path.name.endswith(PARTIAL_SUFFIX) for path in there)

    environment = os.environ | {"V2V_CACHE_DIR": str(cache)}
    victim = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: victim.poll() is not None or due())
        below = psutil.Process(victim.pid).children(recursive=True) if victim.poll() is None else []
    finally:
        victim.kill()
        victim.wait()
    psutil.wait_procs(below, timeout=_KILLED_SECONDS)
    return victim.returncode == -signal.SIGKILL


@pytest.mark.parametrize("turn", [0, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (1, 2, 3))])
def test_killed_at_a_random_moment(source: Path, tmp_path: Path, turn: int) -> None:
    """Killed in the middle of a file, once a random number of others are done; again; and then finished."""
    out, rng = tmp_path / "out", random.Random(turn)
    command = [
        sys.executable,
        "-m",
        "v2v_protocol.programs",
        "prepare",
        str(source),
        str(out),
        "--workers",
        "2",
    ]
    for _ in range(1 + turn % 2):
        if _killed_in_the_middle(command, tmp_path / "cache", out, rng.randrange(3)):
            records = read_manifest(out).videos
            assert all(is_whole(out / id) for id in records)
    last = run(source, out)
    assert last.complete
    assert not list(out.rglob(f"*{PARTIAL_SUFFIX}"))
    # Whole and right, whichever process made them.
    for video in last.videos:
        assert is_whole(out / video.id)
        np.testing.assert_array_equal(stored_whole(out / video.id), whole(source / video.id))


def test_an_unfinished_line_counts_as_not_written(source: Path, out: Path) -> None:
    manifest = (out / MANIFEST_NAME).read_bytes()
    (out / MANIFEST_NAME).write_bytes(manifest[:-25])
    with pytest.raises(CorpusError, match="4 of 5 videos are prepared; run v2v-prepare again"):
        opened(out)
    assert run(source, out).kept == 5  # its file says what it is
    assert len(opened(out).videos) == 5


def test_command_line(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "cache"))
    out = tmp_path / "out"
    settings = ["--rows", "top:0.54", "--size", "fast", "--workers", "1"]
    main([str(source), str(out), *settings, "--json", str(tmp_path / "report.json")])
    told = capsys.readouterr().out
    assert "5 of 5 videos prepared as fast (0 of them earlier)" in told
    assert " MB -> " in told
    assert (tmp_path / "report.json").read_text().count("source_fingerprint") == 5
    (tmp_path / "list.txt").write_text("0.mp4 24 0.3 0.3\nsub/4.mp4\n")
    main([str(source), str(tmp_path / "two"), "--list", str(tmp_path / "list.txt"), "--workers", "1"])
    assert "2 of 2 videos prepared as dense" in capsys.readouterr().out
    for arguments, status, message in (
        ([str(source), str(source / "in")], 2, "overlap; choose a destination outside the source"),
        ([str(source), str(out), "--size", "tiny"], 2, "invalid choice: 'tiny'"),
        ([str(source), str(out), "--workers", "0"], 2, "--workers 0"),
        ([str(tmp_path / "none"), str(out)], 2, "no such folder"),
        ([str(source), str(out), "--json", str(tmp_path)], 2, "it is a folder; give the name of a file"),
    ):
        assert main(arguments) == status
        shown = capsys.readouterr()
        assert message in shown.out + shown.err
    shutil.copy(source / "0.mp4", source / "5.mp4")
    (source / "6.mp4").write_bytes(b"no video")
    assert main([str(source), str(out), *settings]) == 1
    shown = capsys.readouterr().out
    assert "6 of 6 videos prepared" in shown
    assert "1 cannot be used:\n  6.mp4: " in shown
