"""A corpus catalogued ahead: on many hosts, and killed in the middle, it is the catalogue of one run."""

from __future__ import annotations

import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from tests.waiting import until
from v2v_protocol.errors import UsageError
from v2v_server.commands import catalogue
from v2v_server.commands.catalogue import main
from v2v_server.corpus.catalogue import index_path, open_catalogue, refresh_index
from v2v_server.corpus.index import FigureKind, Figures, Shard, Store
from v2v_server.corpus.videos import IndexRow

_STOPS = """
import signal, sys
from v2v_server.corpus import probe
from v2v_server.commands.catalogue import main
probe._MOST_TOGETHER = 2
look, looked_into = probe._facts, []
def stops(path, kind):
    looked_into.append(path)
    if len(looked_into) == 7:
        signal.pause()
    return look(path, kind)
probe._facts = stops
import v2v_server.commands.catalogue as ahead
refresh = ahead.refresh_index
ahead.refresh_index = lambda root, ids, path, scenes, processes, *more: refresh(root, ids, path, scenes, 0, *more)
sys.exit(main(sys.argv[1:]))
"""
"""Probes in the command's own process, which writes down two files at a time and stops at the seventh."""

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    clip = write_clip(folder / "clip.mp4", panned_luma(30), b_frames=2)
    for number in range(9):
        (folder / f"{number // 3}").mkdir(exist_ok=True)
        shutil.copy(clip, folder / f"{number // 3}" / f"{number}.mp4")
    (folder / "broken.mp4").write_bytes(b"no video")
    return folder


@pytest.fixture
def run(corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Return a function that runs the command, which probes in this process."""
    monkeypatch.setattr(
        catalogue, "open_catalogue", lambda videos, **asked: open_catalogue(videos, **(asked | {"processes": 0}))
    )
    monkeypatch.setattr(
        catalogue, "refresh_index",
        lambda root, ids, path, scenes, processes, *more: refresh_index(root, ids, path, scenes, 0, *more),
    )  # fmt: skip

    def on(host: str, *flags: str, videos: str = "") -> tuple[int, str, str]:
        """Exit status, and what was said and complained of, on a host with a cache folder of its own."""
        here = ["--videos", videos or str(corpus), "--cache-dir", str(tmp_path / host), "--workers", "1"]
        status = main([*here, *flags])
        said = capsys.readouterr()
        return status, said.out, said.err

    return on


def digests(said: str) -> list[str]:
    return re.findall(r"\b[0-9a-f]{32}\b", said)


def looked_into(said: str) -> int:
    return int(re.findall(r"probed (\d+) files", said)[-1])


def test_parts_of_two_hosts_are_the_catalogue_of_one_and_what_changed_since_is_looked_into_again(
    corpus: Path, tmp_path: Path, run: Run
) -> None:
    videos, parts, scene = tmp_path / "videos", str(tmp_path / "parts"), ("--scene", "auto", "--rows", "top:0.5")
    shutil.copytree(corpus, videos)
    said = [run(f"host {n}", "--shard", f"{n}/2", "--out", parts, *scene, videos=str(videos))[1] for n in (1, 2)]
    assert sum(int(re.findall(r": (\d+) of 11 videos", each)[0]) for each in said) == 11
    status, whole, _ = run("one", *scene, videos=str(videos))
    assert (status, len(digests(whole))) == (0, 2)
    assert "10 videos can be used" in whole
    assert "  broken.mp4" in whole
    for looked in (0, 2):  # the changed one is probed, then analysed
        if looked:
            write_clip(videos / "clip.mp4", panned_luma(12))
        _, merged, _ = run("server", *scene, "--merge", parts, videos=str(videos))
        assert digests(merged) == digests(run("one", *scene, videos=str(videos))[1])
        assert looked_into(merged) == looked


def test_a_killed_shard_goes_on_where_it_was(corpus: Path, tmp_path: Path, run: Run) -> None:
    flags = ["--shard", "1/1", "--out", str(tmp_path / "parts")]
    known = index_path(corpus.resolve(), tmp_path / "host", Shard(1, 1))
    command = [sys.executable, "-c", _STOPS, "--videos", str(corpus), "--cache-dir", str(tmp_path / "host"), *flags]
    with subprocess.Popen(command) as running:
        try:
            until(lambda: running.poll() is not None or rows(known) >= 4)
        finally:
            running.kill()
    assert running.returncode == -signal.SIGKILL
    before = rows(known)
    assert not list((tmp_path / "parts").iterdir())
    status, said, _ = run("host", *flags)
    assert status == 0
    assert 0 < looked_into(said) == 11 - before
    _, merged, _ = run("server", "--merge", str(tmp_path / "parts"))
    assert digests(merged) == digests(run("one")[1])


def rows(index: Path) -> int:
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"{index.as_uri()}?mode=ro", uri=True)) as database:
        return int(database.execute("SELECT COUNT(*) FROM video").fetchone()[0])
    return 0


def test_parts_that_cannot_be_put_together_are_said(tmp_path: Path, run: Run) -> None:
    parts = tmp_path / "parts"
    status, _, said = run("server", "--merge", str(parts))
    assert (status, "cannot be read" in said) == (2, True)
    parts.mkdir()
    assert "holds no part" in run("server", "--merge", str(parts))[2]
    run("host", "--shard", "2/3", "--out", str(parts))
    said = run("server", "--merge", str(parts))[2]
    assert said.endswith("2 of 3 parts are missing; run v2v-catalogue --shard for 1/3, 3/3\n")
    run("host", "--shard", "1/1", "--out", str(parts))
    assert "holds parts of splits into 1 and 3" in run("server", "--merge", str(parts))[2]
    (parts / "part-2-of-3.sqlite3").unlink()
    with closing(sqlite3.connect(parts / "part-1-of-1.sqlite3")) as old:
        old.execute("PRAGMA user_version = 1")
    assert "is an index of version 1, this program reads" in run("server", "--merge", str(parts))[2]
    (tmp_path / "full").touch()
    assert "full/catalogue-" in run("full", "--merge", str(parts))[2]
    (parts / "part-1-of-1.sqlite3").write_bytes(b"SQLite format 3\0" + b"x" * 5000)
    status, out, said = run("server", "--merge", str(parts))
    assert (status, out) == (2, "")
    assert re.search(r"part-1-of-1\.sqlite3: cannot be put into .*: file is not a database\n$", said)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--shard", "0/3", "--out", "parts"], "give NUMBER/COUNT from 1/COUNT"),
        (["--shard", "4/3", "--out", "parts"], "give NUMBER/COUNT from 1/COUNT"),
        (["--shard", "1/3"], "--shard K/N needs --out DIR"),
        (["--out", "parts"], "--shard K/N needs --out DIR"),
        (["--shard", "1/3", "--out", "parts", "--merge", "parts"], "give one of them"),
        (["--workers", "0"], "give at least 1"),
    ],
)
def test_flags_that_make_no_sense(run: Run, flags: list[str], said: str) -> None:
    status, out, error = run("host", *flags)
    assert (status, out) == (2, "")
    assert said in error


def test_a_folder_that_takes_no_part_is_said_before_any_work(corpus: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "file").touch()
    status, _, said = run("host", "--shard", "1/2", "--out", str(tmp_path / "file" / "parts"))
    assert (status, "cannot be written to" in said) == (2, True)
    assert not (tmp_path / "host").exists()


def test_a_shard_without_a_video_is_a_part_too(tmp_path: Path, run: Run) -> None:
    for number in range(1, 13):
        assert run("host", "--shard", f"{number}/12", "--out", str(tmp_path / "parts"))[0] == 0
    _, merged, _ = run("server", "--merge", str(tmp_path / "parts"))
    assert digests(merged) == digests(run("one")[1])
    assert looked_into(merged) == 0


@given(ids=st.sets(st.text(min_size=1), max_size=8), count=st.integers(1, 40))
def test_each_file_is_of_one_shard(ids: set[str], count: int) -> None:
    shards = [Shard.parse(f"{number}/{count}") for number in range(1, count + 1)]
    assert len({shard.file_name for shard in shards}) == count
    assert sorted(shard.file_name for shard in shards) == [shard.file_name for shard in shards]
    for id in ids:
        assert [shard.holds(id) for shard in shards].count(True) == 1


@pytest.mark.parametrize("text", ["", "3", "/3", "3/", "1/0", "-1/3", "1/3/5", "one/two", "1/100000"])
def test_what_is_no_shard(text: str) -> None:
    with pytest.raises(UsageError, match="give NUMBER/COUNT"):
        Shard.parse(text)


def test_an_index_that_knows_something_already_keeps_it(tmp_path: Path) -> None:
    kind = FigureKind("scene", "1")
    with closing(Store(tmp_path / "one")) as one, closing(Store(tmp_path / "other")) as other:
        one.put(
            [
                IndexRow(name, 1, fingerprint=fingerprint, problem="cut off")
                for name, fingerprint in (("a", "old"), ("b", "kept"))
            ]
        )
        other.put([IndexRow("a", 2, fingerprint="new", problem="cut off"), IndexRow("c", 3, problem="cut off")])
        other.make_figures()
        other.put_figures(kind, [Figures("a", "new", b"summary", b"scene")])
        assert one.merge(tmp_path / "other") == 2
        assert [(row[0], row[4]) for row in one.rows(None)] == [("a", "new"), ("b", "kept"), ("c", "")]
        assert one.figures("a", "new", kind) == b"scene"
