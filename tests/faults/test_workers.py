"""Workers that die, hang or run out of memory at every stage of their work, for real."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.clips import panned_luma, write_clip
from tests.packed import packed_forms
from tests.stream.conftest import SMALL, SMALL_FLAGS, Corpus, digest, epoch_of, server_workers
from tests.waiting import has_ended, until
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import NoWorkers, ServerLost
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.quarantine import read_quarantine
from v2v_tools.remake import remake

INJECT = Path(__file__).parent / "inject"
pytestmark = pytest.mark.slow


@contextmanager
def _faulty(
    monkeypatch: pytest.MonkeyPatch, videos: Path, *flags: str, flags_of: tuple[str, ...] = SMALL_FLAGS, **fault: Any
) -> Iterator[LocalServer]:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(INJECT), os.environ.get("PYTHONPATH")))))
    monkeypatch.setenv("V2V_FAULT", json.dumps(fault))
    with LocalServer(videos, workers=2, flags=[*flags_of, *flags]) as server:
        yield server


@pytest.fixture(scope="module")
def reference(clips: Path) -> list[str]:
    """Digests of an undisturbed epoch."""
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as server:
        return [digest(batch) for batch in epoch_of(server.address)]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A quarantine of the test's own."""
    return tmp_path / "cache"


@contextmanager
def worker(address: str, videos: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A worker as on another host, until the block ends."""
    command = [sys.executable, "-m", "v2v_server.commands.worker", "--connect", address, "--videos", str(videos)]
    with subprocess.Popen(command) as process:
        try:
            yield process
        finally:
            process.terminate()


def address_for_workers(server: LocalServer) -> str:
    """Return where workers connect to a server that has just started."""
    return server.last_lines().partition("workers to ")[2].split()[0]


def test_where_no_sample_can_come_the_consumer_says_why_and_ends(clips: Path, tmp_path: Path) -> None:
    """A server without workers; and one whose only worker has another folder, until one comes that has the videos."""
    with LocalServer(clips, workers=0, flags=[*SMALL_FLAGS, "--worker-bind", "tcp://127.0.0.1:*"]) as server:
        address = address_for_workers(server)

        def first(timeout_seconds: float) -> Batch:
            return next(iter(V2VStreamDataset(server.address, recipe=SMALL, timeout_seconds=timeout_seconds)))

        with pytest.raises(NoWorkers, match="no worker is connected"):
            first(3.0)
        with worker(address, tmp_path):
            # Until it has started and failed, the message can only say that none is connected.
            text = ""
            while "can read its videos" not in text:
                with pytest.raises(NoWorkers) as caught:
                    first(4.0)
                text = str(caught.value)
            assert "--videos" in text
            with worker(address, clips):
                assert first(600.0).indices[0] == 0  # it may have to compile


def test_a_worker_whose_host_lacks_the_videos_changes_nothing(
    clips: Path, tmp_path: Path, reference: list[str]
) -> None:
    """It fails fastest, so it is asked most: an empty mount point, say."""
    with LocalServer(clips, workers=1, flags=[*SMALL_FLAGS, "--worker-bind", "tcp://127.0.0.1:*"]) as server:
        with worker(address_for_workers(server), tmp_path) as lacking:
            while "failed on" not in server.last_lines():
                assert [digest(batch) for batch in epoch_of(server.address)] == reference
            assert lacking.poll() is None
        assert "Check --videos on its host" in server.last_lines()


@pytest.mark.parametrize(
    ("action", "stage"),
    [*(("SIGKILL", stage) for stage in ("decode", "simulate", "send")), ("exit", "simulate"), ("memory", "decode")],
)
def test_a_death_without_blame_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path, reference: list[str], stage: str, action: str
) -> None:
    once = tmp_path / "done"
    with _faulty(monkeypatch, clips, stage=stage, action=action, once=str(once)) as server:
        assert [digest(batch) for batch in epoch_of(server.address)] == reference
    assert once.exists()


def test_a_death_while_a_video_of_any_kind_is_read_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, corpus: Corpus
) -> None:
    with LocalServer(corpus.folder, workers=2, flags=corpus.flags) as server:
        undisturbed = [digest(batch) for batch in epoch_of(server.address, recipe=corpus.recipe)]
    fault: dict[str, Any] = {"stage": "decode", "action": "SIGKILL", "once": str(tmp_path / "done")}
    with _faulty(monkeypatch, corpus.folder, flags_of=corpus.flags, **fault) as server:
        assert [digest(batch) for batch in epoch_of(server.address, recipe=corpus.recipe)] == undisturbed
    assert (tmp_path / "done").exists()


@pytest.mark.parametrize("stage", ["simulate", "send"])
def test_a_stopped_worker_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path, reference: list[str], stage: str
) -> None:
    fault = {"stage": stage, "action": "SIGSTOP", "once": str(tmp_path / "done")}
    with _faulty(monkeypatch, clips, "--lease-deadline-seconds", "2", **fault) as server:
        assert [digest(batch) for batch in epoch_of(server.address)] == reference
    assert (tmp_path / "done").exists()


@pytest.mark.parametrize("stage", ["simulate", "send"])
def test_a_worker_that_loses_its_connection_is_replaced(
    monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path, cache: Path, reference: list[str], stage: str
) -> None:
    """Its confinement lets it open no other one; its server is alive, so it does not end with it."""
    once = tmp_path / "done"
    flags = ("--cache-dir", str(cache))
    with _faulty(monkeypatch, clips, *flags, stage=stage, action="disconnect", once=str(once)) as server:
        assert server.pid is not None
        first = {worker.pid for worker in server_workers(server.pid)}
        assert [digest(batch) for batch in epoch_of(server.address)] == reference
        assert once.exists()
        until(lambda: len(first & {worker.pid for worker in server_workers(server.pid)}) == 1)
        until(lambda: len(server_workers(server.pid)) == 2)
        assert [digest(batch) for batch in epoch_of(server.address)] == reference
    assert not list(cache.rglob("quarantine*.jsonl"))


@pytest.mark.parametrize(
    ("stage", "action"), [("decode", "SIGSEGV"), ("simulate", "SIGABRT"), ("send", "SIGBUS"), ("decode", "hang")]
)
def test_a_crash_moves_its_own_index_only_and_is_written_down(
    monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path, cache: Path, stage: str, action: str
) -> None:
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as server:
        undisturbed = {index: row for batch in epoch_of(server.address) for index, row in _rows(batch)}
    fault = {"stage": stage, "action": action, "once": str(tmp_path / "done")}
    flags = ("--cache-dir", str(cache), "--lease-deadline-seconds", "3")
    with _faulty(monkeypatch, clips, *flags, **fault) as server:
        batches = epoch_of(server.address)
    disturbed = {index: row for batch in batches for index, row in _rows(batch)}
    moved = [item for batch in batches for item in batch.provenance if item.refusals]
    assert len(moved) == 1
    assert moved[0].candidate == 1
    assert moved[0].quarantine == 1
    assert {index for index in undisturbed if undisturbed[index] != disturbed[index]} == {moved[0].id.index}
    (line,) = (json.loads(text) for text in next(cache.glob("quarantine-*.jsonl")).read_text().splitlines())
    assert (line["snapshot"], line["path"]) == (1, moved[0].refusals[0].video)
    assert line["reason"] in moved[0].refusals[0].reason

    with closing(open_catalogue(clips, cache_dir=cache)) as catalogue:
        held = read_quarantine(next(cache.glob("quarantine-*.jsonl")))
        again = remake(
            catalogue, StreamSpec(recipe=SMALL), seed=3, epoch=0, index=moved[0].id.index, quarantine=held, snapshot=1
        )
        assert again.arrays["voxels"].tobytes() == disturbed[moved[0].id.index][0]
        assert again.provenance.candidate == 1


def test_a_poison_video_is_quarantined_and_stays_so(
    monkeypatch: pytest.MonkeyPatch, corpus: Corpus, cache: Path
) -> None:
    poison = corpus.one
    fault: dict[str, Any] = {"stage": "decode", "action": "SIGSEGV", "video": poison, "flags_of": corpus.flags}
    with _faulty(monkeypatch, corpus.folder, "--cache-dir", str(cache), **fault) as server:
        first = [batch for epoch in (0, 1) for batch in epoch_of(server.address, epoch=epoch, recipe=corpus.recipe)]
        said = server.last_lines()
    assert "quarantine" in said
    videos = {item.video for batch in first for item in batch.provenance}
    assert poison not in videos
    verdicts = [json.loads(text) for text in next(cache.glob("quarantine-*.jsonl")).read_text().splitlines()]
    assert {line["path"] for line in verdicts} == {poison}
    # Both workers may have been at it when the second verdict fell; after that it is not leased.
    assert 2 <= len(verdicts) <= 4

    with _faulty(monkeypatch, corpus.folder, "--cache-dir", str(cache), **fault) as server:
        pids = {worker.pid for worker in server_workers(server.pid)}
        again = [batch for epoch in (0, 1) for batch in epoch_of(server.address, epoch=epoch, recipe=corpus.recipe)]
        assert {worker.pid for worker in server_workers(server.pid)} == pids
    assert {item.quarantine for batch in again for item in batch.provenance} == {len(verdicts)}


def test_a_member_of_an_archive_is_quarantined_as_the_file_is(
    monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path
) -> None:
    poison, found = "0/deep/c.mp4", {}
    shutil.copytree(clips, tmp_path / "folder" / "0")
    for form, folder in packed_forms(tmp_path / "folder", tmp_path).items():
        cache = tmp_path / "cache" / form
        fault = {"stage": "decode", "action": "SIGSEGV", "video": poison}
        with _faulty(monkeypatch, folder, "--cache-dir", str(cache), **fault) as server:
            served = [
                item.video
                for epoch in (0, 1)
                for batch in epoch_of(server.address, epoch=epoch)
                for item in batch.provenance
            ]
        assert poison not in served
        (file,) = cache.glob("quarantine-*.jsonl")
        found[form] = {(line.path, line.fingerprint, line.reason, line.spec) for line in read_quarantine(file).lines}
    assert found["folder"] == found["tar"] == found["zip"]
    assert {path for path, *_ in found["folder"]} == {poison}


def test_memory_that_runs_out_is_no_verdict_on_a_video_for_other_specs(
    monkeypatch: pytest.MonkeyPatch, clips: Path, cache: Path
) -> None:
    """One spec may ask for more than a worker has. Another spec of the same video is not to blame."""
    fault = {"stage": "decode", "action": "memory", "video": "deep/er/f.mp4"}
    with _faulty(monkeypatch, clips, "--cache-dir", str(cache), **fault) as server:
        batches = epoch_of(server.address)
    assert fault["video"] not in {item.video for batch in batches for item in batch.provenance}
    verdicts = [json.loads(text) for text in next(cache.glob("quarantine-*.jsonl")).read_text().splitlines()]
    assert {(line["path"], line["spec"]) for line in verdicts} == {
        (fault["video"], item.id.spec_digest) for item in batches[0].provenance
    }


def test_workers_that_always_die_end_in_one_clear_error(
    monkeypatch: pytest.MonkeyPatch, clips: Path, cache: Path
) -> None:
    with _faulty(monkeypatch, clips, "--cache-dir", str(cache), stage="decode", action="exit") as server:
        process = psutil.Process(server.pid)
        dataset = V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3, timeout_seconds=90)
        with pytest.raises(ServerLost):  # patient: workers die only while somebody asks for samples
            list(dataset)
        until(lambda: has_ended(process))
        assert "died in a row without finishing a sample" in server.last_lines()


@pytest.mark.parametrize("change", ["gone", "shrunk", "garbage"])
def test_a_video_that_changes_after_it_was_catalogued_is_passed_over(tmp_path: Path, change: str) -> None:
    folder = tmp_path / "clips"
    folder.mkdir()
    for number in range(4):
        write_clip(folder / f"clip{number}.mp4", panned_luma(64, step=(1, 1 + number)), gop=16)
    victim = folder / "clip2.mp4"
    with LocalServer(folder, workers=2, flags=SMALL_FLAGS) as server:
        if change == "gone":
            victim.unlink()
        elif change == "shrunk":
            os.truncate(victim, victim.stat().st_size // 2)
        else:
            victim.write_bytes(os.urandom(victim.stat().st_size))
        batches = [batch for epoch in (0, 1) for batch in epoch_of(server.address, epoch=epoch, batch_size=2)]
    refused = {refusal.video for batch in batches for item in batch.provenance for refusal in item.refusals}
    assert refused == {"clip2.mp4"}
    assert {item.video for batch in batches for item in batch.provenance} == {"clip0.mp4", "clip1.mp4", "clip3.mp4"}
    assert len(batches) == 12


def _rows(batch: Batch) -> list[tuple[int, tuple[bytes, bytes]]]:
    arrays = batch.arrays
    return [
        (index, (arrays["voxels"][row].numpy().tobytes(), arrays["frames"][row].numpy().tobytes()))
        for row, index in enumerate(batch.indices)
    ]
