"""Signals and the death of loader workers, where batches are taken from."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator

import psutil
import pytest
import torch
from torch._utils import ExceptionWrapper

from tests.client.fake_server import FakeServer
from trainer.feed import Feed, _without_trace
from trainer.run.interruption import StopRequest
from v2v_client import V2VStreamDataset
from v2v_protocol.errors import RemoteError, ServerLost, V2VError

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _no_handler_yet(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As in a process that has had no DataLoader yet: PyTorch installs its handler once."""
    monkeypatch.setattr("torch.utils.data._utils.signal_handling._SIGCHLD_handler_set", False)
    before = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGCHLD, before)


class Installing(V2VStreamDataset):
    """Installs a handler when an iteration begins, as a DataLoader does; then it may go wrong."""

    fails = False

    def __iter__(self) -> Iterator[int]:  # type: ignore[override]
        signal.signal(signal.SIGCHLD, lambda *_: None)
        if self.fails:
            raise KeyboardInterrupt
        return iter(range(3))


@pytest.mark.parametrize("before", [signal.SIG_DFL, signal.default_int_handler], ids=["none", "one"])
def test_the_previous_handler_is_active_during_a_step(before: signal.Handlers) -> None:
    signal.signal(signal.SIGCHLD, before)
    for _ in Feed(Installing("tcp://127.0.0.1:1"), CPU).epochs(0, 2):
        assert signal.getsignal(signal.SIGCHLD) is before


def test_the_previous_handler_is_restored_if_iterating_fails() -> None:
    dataset = Installing("tcp://127.0.0.1:1")
    dataset.fails = True
    with pytest.raises(KeyboardInterrupt):
        next(Feed(dataset, CPU).epochs(0, 1))
    assert signal.getsignal(signal.SIGCHLD) is signal.SIG_DFL


@pytest.mark.parametrize(
    "error", [ServerLost("tcp://host:1: nothing heard for 2 s"), RemoteError("no-sample", "it is gone")]
)
def test_an_error_of_a_loader_worker_is_its_message_alone(error: V2VError) -> None:
    try:
        raise error
    except V2VError:
        carried = ExceptionWrapper(where="in DataLoader worker process 0")
    with pytest.raises(type(error), match="Traceback") as caught:
        carried.reraise()
    told = _without_trace(caught.value)
    assert (type(told), str(told)) == (type(error), str(error))
    assert str(_without_trace(error)) == str(error)
    assert getattr(told, "code", None) == getattr(error, "code", None)


def loader_worker(before: set[psutil.Process]) -> psutil.Process:
    """The one process of a loader that is not the resource tracker."""
    started = set(psutil.Process().children()) - before
    (worker,) = [process for process in started if "spawn_main" in " ".join(process.cmdline())]
    return worker


def until_ended(child: psutil.Process) -> None:
    """Wait until all threads of a child are gone, and leave it to be reaped; its pipes end earlier."""
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)


def test_moving_a_batch_to_a_gpu_counts_as_transfer_not_as_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in takes a quarter of a second for it, by a clock that nothing else moves."""
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])

    def moved(batch: object, _copies: object) -> object:
        now[0] += 0.25
        return batch

    monkeypatch.setattr("trainer.feed._moved", moved)
    feed = Feed(Installing("tcp://127.0.0.1:1"), CPU)
    feed._copies = object()  # type: ignore[assignment]
    assert len(list(feed.epochs(0, 2))) == 6
    assert (feed.wait_seconds, feed.transfer_seconds) == (0.0, 1.5)


@pytest.mark.slow
def test_a_signal_to_the_whole_group_lets_the_step_finish() -> None:
    """The loader worker dies of it in the middle of the step; the run ends after the step."""
    before, finished = set(psutil.Process().children()), []
    with FakeServer() as server, StopRequest() as stop:
        feed = Feed(V2VStreamDataset(server.address, batch_size=2, timeout_seconds=60.0), CPU, loader_workers=1)
        for batch in stop.until(feed.epochs(0, 2)):
            worker = loader_worker(before)
            # By somebody else: of its parent, a loader worker takes SIGTERM for an ordinary end.
            subprocess.run(["sh", "-c", f"kill -TERM {worker.pid} {os.getpid()}"], check=True)
            until_ended(worker)
            finished.append(batch.indices)
        del feed
    assert finished == [(0, 1)]
    assert stop.signal == signal.SIGTERM


@pytest.mark.slow
def test_a_loader_worker_that_dies_by_itself_is_noticed() -> None:
    before = set(psutil.Process().children())
    with FakeServer() as server:
        feed = Feed(V2VStreamDataset(server.address, batch_size=2, timeout_seconds=60.0), CPU, loader_workers=1)
        batches = feed.epochs(0, 2)
        assert next(batches).indices == (0, 1)
        worker = loader_worker(before)
        worker.kill()
        until_ended(worker)
        with pytest.raises(RuntimeError, match="exited unexpectedly"), StopRequest() as stop:
            list(stop.until(batches))
        del batches, feed
