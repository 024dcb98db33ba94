"""What SECURITY.md says of stream workers on the server's host, tried inside their confinement, and that samples still
arrive through shared memory.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of, made_here, server_workers
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_server.status.client import StatusClient
from v2v_server.system.sandbox import can_confine

ATTEMPTS = Path(__file__).parent / "attempts"
pytestmark = pytest.mark.skipif(
    not can_confine().calls or not can_confine().files, reason="this kernel has no seccomp or no Landlock"
)


def totals(address: str) -> dict[str, Any]:
    with StatusClient(address) as client:
        found: dict[str, Any] = client.get_status()["totals"]
        return found


def open_names(pid: int) -> list[str]:
    """Return what each descriptor of a process refers to."""
    names = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            names.append(os.readlink(descriptor))
    return names


def open_files(pid: int) -> Counter[str]:
    """Count what a process has open by kind: sockets and shared memory each count as one kind."""
    return Counter(name.partition(":")[0] for name in open_names(pid))


@contextmanager
def attempting(clips: Path, folder: Path, *flags: str) -> Iterator[tuple[LocalServer, Path]]:
    """A server of one worker, and the folder with what its worker attempts."""
    (folder / "notes").write_bytes(b"before")
    (folder / "report").touch()
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"]) as other, ExitStack() as stack:
        stack.callback(other.kill)
        given = {"report": str(folder / "report"), "home": str(folder), "pid": other.pid}
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(ATTEMPTS), os.environ.get("PYTHONPATH")))))
            patch.setenv("V2V_ATTEMPTS", json.dumps(given))
            server = stack.enter_context(LocalServer(clips, workers=1, flags=[*SMALL_FLAGS, *flags]))
        yield server, folder


@pytest.fixture(scope="module")
def alone(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LocalServer, Path]]:
    with attempting(clips, tmp_path_factory.mktemp("attempts")) as running:
        yield running


def test_a_worker_reads_files_and_nothing_else(alone: tuple[LocalServer, Path]) -> None:
    require_confined(*alone)


def test_nor_does_one_that_shares_samples_and_connects_by_tcp(clips: Path, tmp_path: Path) -> None:
    with attempting(clips, tmp_path, "--share-gib", "1", "--worker-bind", "tcp://127.0.0.1:*") as running:
        require_confined(*running)


def require_confined(server: LocalServer, folder: Path) -> None:
    earlier = totals(server.address)
    assert len(epoch_of(server.address)) == 8
    assert len(server_workers(server.pid)) == 1
    later = totals(server.address)
    assert later["in_slots"] - earlier["in_slots"] == later["samples"] - earlier["samples"] > 0
    lines = [json.loads(line) for line in (folder / "report").read_text().splitlines()]
    assert lines
    for found in lines:
        assert found.pop("threads") == 1  # when the files were closed, so it holds for all later ones
        assert found.pop("filters") == ["2"]  # in all threads: the second is the one against sockets
        assert found.pop("in a thread") is True
        assert found.pop("read") == "done"
        assert [name for name, gave in found.items() if gave not in ("EPERM", "EACCES")] == []
    assert (folder / "notes").read_bytes() == b"before"


def test_a_killed_workers_successor_gets_slots_and_a_consumer_that_leaves_no_memory(
    clips: Path, alone: tuple[LocalServer, Path]
) -> None:
    server, _ = alone
    reference = [digest(batch) for batch in made_here(clips, 0)]
    assert [digest(batch) for batch in epoch_of(server.address)] == reference
    (worker,) = server_workers(server.pid)
    before = open_files(server.pid)
    worker.kill()
    until(lambda: [each.pid for each in server_workers(server.pid)] not in ([], [worker.pid]))
    earlier = totals(server.address)
    assert [digest(batch) for batch in epoch_of(server.address)] == reference
    later = totals(server.address)
    assert later["in_slots"] - earlier["in_slots"] == later["samples"] - earlier["samples"] >= len(reference)
    gc.collect()
    until(lambda: open_files(server.pid)["/memfd"] == before["/memfd"])
    (successor,) = server_workers(server.pid)
    until(
        lambda: (
            not [
                name
                for process in (server.pid, successor.pid)
                for name in open_names(process)
                if "v2v-" in name and "logbook" not in name
            ]
        )
    )


def test_a_worker_outlasts_a_server_that_is_stopped(alone: tuple[LocalServer, Path]) -> None:
    """It makes no other connection, so it must not give up this one."""
    server, _ = alone
    iterator = iter(V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, timeout_seconds=120.0))
    next(iterator)
    (worker,) = server_workers(server.pid)
    psutil.Process(server.pid).suspend()
    try:
        with pytest.raises(psutil.TimeoutExpired):
            worker.wait(13.0)  # longer than the silence after which a worker elsewhere connects again
    finally:
        psutil.Process(server.pid).resume()
    assert len(list(iterator)) == 7
    assert [each.pid for each in server_workers(server.pid)] == [worker.pid]
