"""Full disks: the catalogue's index, the quarantine, and the destination of ``v2v-prepare``.

A limit on the size of files stands for a full disk where nothing may be mounted; where it may, the disk is really full.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from tests.faults.private_mounts import mounted
from tests.stream.conftest import SMALL_FLAGS, digest, epoch_of
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources.prepared import read_manifest
from v2v_server.prepare import PARTIAL_SUFFIX, prepare
from v2v_server.quarantine import read_quarantine
from v2v_server.store.store_file import StoreFile

INJECT = Path(__file__).parent / "inject"
INDEX_NOTE = re.compile(r"the catalogue's index \S+ cannot be used \((disk I/O error|database or disk is full)\)")


def _limited(limit_bytes: int, *command: str) -> list[str]:
    return [sys.executable, "-m", "tests.faults.limited", str(limit_bytes), *command]


def _full(folder: Path, command: Sequence[str], size: str = "64k") -> list[str]:
    """The command, with a file system of no free page at ``folder``."""
    filled = f'mount -t tmpfs -o size={size} tmpfs "{folder}" && head -c {size[:-1]}K /dev/zero > "{folder}/filler"'
    return mounted(filled, command)


def _hindered(is_full: bool, cache: Path, command: Sequence[str]) -> list[str]:
    return _full(cache, [sys.executable, "-m", *command]) if is_full else _limited(64, *command)


class Served:
    """A server whose standard error is read at its end: a file would be full too."""

    def __init__(self, process: subprocess.Popen[str], address: str) -> None:
        self.address = address
        self._process = process

    def end(self) -> str:
        """What it has said; it ends properly."""
        self._process.terminate()
        _, said = self._process.communicate()
        assert self._process.returncode == 0, said
        return said


@contextmanager
def _serving(folder: Path, command: Sequence[str], **environment: str) -> Iterator[Served]:
    port = folder / "port"
    environment = os.environ | environment
    command = [*command, "--port-file", str(port)]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            until(lambda: port.exists() or process.poll() is not None)
            assert process.poll() is None, process.communicate()[1]
            yield Served(process, port.read_text(encoding="utf-8").strip())
        finally:
            process.kill()


def _server(clips: Path, cache: Path, *flags: str) -> list[str]:
    where = ["--videos", str(clips), "--cache-dir", str(cache), "--bind", "tcp://127.0.0.1:*"]
    return ["v2v_server", *where, "--workers", "2", *SMALL_FLAGS, *flags]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


# --- the index --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("is_full", [False, True])
def test_an_index_that_cannot_be_written_costs_one_line(
    clips: Path, cache: Path, server: LocalServer, is_full: bool
) -> None:
    expected = [digest(batch) for batch in epoch_of(server.address)]
    with _serving(cache.parent, _hindered(is_full, cache, _server(clips, cache))) as served:
        assert [digest(batch) for batch in epoch_of(served.address)] == expected
        assert len(INDEX_NOTE.findall(served.end())) == 1
    # What is left of the index does not stand in the way of the next start.
    with _serving(cache.parent, [sys.executable, "-m", *_server(clips, cache)]) as served:
        assert not INDEX_NOTE.search(served.end())
    with closing(open_catalogue(clips, cache_dir=cache)) as catalogue:
        assert catalogue.notes == ()


# --- the quarantine ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("is_full", [False, True])
def test_a_quarantine_that_cannot_be_written(clips: Path, cache: Path, server: LocalServer, is_full: bool) -> None:
    expected = epoch_of(server.address)
    folder, command = cache.parent, _hindered(is_full, cache, _server(clips, cache))
    fault = {"stage": "decode", "action": "SIGSEGV", "once": str(folder / "crashed")}
    path = os.pathsep.join(filter(None, (str(INJECT), os.environ.get("PYTHONPATH"))))
    with _serving(folder, command, PYTHONPATH=path, V2V_FAULT=json.dumps(fault)) as served:
        first = epoch_of(served.address)
        again = epoch_of(served.address)
        said = served.end()
    assert (folder / "crashed").exists()
    refused = [item for batch in first for item in batch.provenance if item.refusals]
    assert len(refused) == 1
    assert refused[0].quarantine == 0
    assert [digest(batch) for batch in again] == [digest(batch) for batch in expected]
    (line,) = [line for line in said.splitlines() if "the quarantine cannot be written" in line]
    assert refused[0].refusals[0].video in line
    assert "No space left" in line
    left = list(cache.glob("quarantine-*.jsonl"))  # none on a full disk, whose mount is gone
    assert [read_quarantine(each).latest for each in left] == ([] if is_full else [0])


# --- preparing --------------------------------------------------------------------------------------------------------


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "source"
    folder.mkdir()
    first = write_clip(folder / "0.mp4", panned_luma(120))
    for number in range(1, 5):
        shutil.copy(first, folder / f"{number}.mp4")
    return folder


def _preparing(source: Path, out: Path, cache: Path) -> list[str]:
    settings = ["--workers", "2", "--cache-dir", str(cache)]
    return ["v2v_protocol.programs", "prepare", str(source), str(out), *settings]


def _require_it_goes_on(source: Path, out: Path, cache: Path) -> None:
    """The folder is sound, and a second run with room enough does the rest."""
    assert not list(out.rglob(f"*{PARTIAL_SUFFIX}"))
    records = read_manifest(out).videos.values() if (out / "v2v-prepared.jsonl").exists() else ()
    kept = [record for record in records if record.problem is None]
    for record in kept:
        with StoreFile(out / record.id) as stored:
            assert stored.is_whole
    with closing(open_catalogue(source, cache_dir=cache, processes=0)) as catalogue:
        report = prepare(catalogue, out, processes=0)
    assert report.complete
    assert report.kept >= len(kept)  # a file that was finished before its line could be written counts too


def test_preparing_files_that_cannot_be_written(source: Path, tmp_path: Path, cache: Path) -> None:
    out = tmp_path / "out"
    open_catalogue(source, cache_dir=cache, processes=0).close()
    done = subprocess.run(_limited(8192, *_preparing(source, out, cache)), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "0 of 5 videos prepared" in done.stdout
    assert done.stdout.count("File too large") == 5
    _require_it_goes_on(source, out, cache)


@pytest.mark.slow
@pytest.mark.parametrize("room", ["nothing", "a manifest", "some videos"])
def test_preparing_onto_a_full_disk(source: Path, tmp_path: Path, cache: Path, room: str) -> None:
    disk, after = tmp_path / "disk", tmp_path / "after"
    disk.mkdir()
    size, filler = {"nothing": (64, 64), "a manifest": (64, 60), "some videos": (400, 4)}[room]
    # Without the free space that it keeps for others, which would end it before the disk is full.
    program = (
        "from v2v_server import prepare; "
        "prepare.LEAST_FREE_BYTES = -(1 << 40); "
        "import sys; from v2v_server.commands.prepare import main; sys.exit(main())"
    )
    python = shlex.quote(sys.executable)
    run = f'{python} -c "{program}" "$@" || echo "ended with status $?"; cp -r "{disk}/out" "{after}"'
    setup = f'mount -t tmpfs -o size={size}k tmpfs "{disk}"; head -c {filler}K /dev/zero > "{disk}/filler"'
    command = mounted(setup, ["sh", "-c", run, "sh", *_preparing(source, disk / "out", cache)[2:]])
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if room == "nothing":
        assert "ended with status 2" in done.stdout
        assert re.fullmatch(r"v2v-prepare: \S+: cannot be written to: No space left on device\n", done.stderr)
    else:
        assert "ended with status 1" in done.stdout
        prepared = sum(record.problem is None for record in read_manifest(after).videos.values())
        assert f"{prepared} of 5 videos prepared" in done.stdout
        assert done.stdout.count("No space left on device") == 5 - prepared
        assert (0 < prepared < 5) == (room == "some videos")
    _require_it_goes_on(source, after, cache)
