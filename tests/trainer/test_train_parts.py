"""The parts around the training loop, each by itself."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
import weakref
from collections.abc import Callable, Iterator
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.client.fake_server import SPEC, FakeServer
from tests.trainer.training import ALONE
from trainer.config import OptimizerConfig, RunConfig, StreamConfig, TrainConfig
from trainer.feed import flags_of, streams
from trainer.learner import AveragedNetwork, learning_rate
from trainer.models import FireNet
from trainer.run.distributed import ranks
from trainer.run.interruption import StopRequest
from trainer.run.reporting import _planned_steps
from trainer.tasks import Asked
from trainer.tasks.task import liveliest
from trainer.train import serving
from v2v_client import V2VStreamDataset
from v2v_protocol.errors import ServerLost, StateMismatch, UsageError, V2VError, WorkerCrashLoop
from v2v_protocol.recipe import Recipe


def test_a_local_server_gets_the_options_it_needs_at_its_start() -> None:
    recipe = Recipe.from_dict({"preset": "clean", "bins": 3})
    plain = flags_of(StreamConfig(videos="clips", rows="top:0.5"), recipe)
    assert plain[-2:] == ["--rows", "top:0.5"]
    assert plain[plain.index("bins=3") - 1] == "--set"
    assert "--list" not in plain
    assert "--scene" not in plain
    asked = flags_of(StreamConfig(videos="clips", list="some.txt", spec={"scene": "auto"}), recipe)
    assert asked[-6:] == ["--scene", "auto", "--rows", "full", "--list", "some.txt"]
    assert flags_of(StreamConfig(videos="clips", spec={"preset": "natural"}), recipe)[-4:-2] == ["--scene", "auto"]
    assert flags_of(StreamConfig(videos_kind="sequences"), recipe)[-2:] == ["--videos-kind", "sequences"]
    assert "--scene" not in flags_of(StreamConfig(videos="clips", spec={"preset": "natural", "scene": "off"}), recipe)


def test_the_started_server_is_announced_before_it_is_ready(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never(*_: object, **__: object) -> None:
        raise ServerLost("it does not come up")

    monkeypatch.setattr("trainer.train.LocalServer", never)
    settings = StreamConfig(videos="clips", rows="top:0.54", workers=3)
    with pytest.raises(ServerLost), serving(settings, Recipe(), ALONE):
        pass
    assert capsys.readouterr().err == "starting a server: clips, rows top:0.54, 3 workers\n"
    with serving(StreamConfig(address="tcp://127.0.0.1:1"), Recipe(), ALONE) as address:
        assert address == "tcp://127.0.0.1:1"
    assert not capsys.readouterr().err


# --- the averaged network ---------------------------------------------------------------------------------------------


@settings(max_examples=25)  # a linear recurrence
@given(st.lists(st.floats(-10, 10, width=32), min_size=1, max_size=30), st.floats(0, 0.999))
def test_the_average_is_the_recurrence_of_its_docstring(values: list[float], decay: float) -> None:
    network = FireNet(bins=1, base_channels=1)
    bias = network.net.pred.conv2d.bias
    assert bias is not None
    expected = float(bias.detach())
    average = AveragedNetwork(network, decay)
    assert not any(parameter.requires_grad for parameter in average.network.parameters())
    for update, value in enumerate(values, start=1):
        with torch.no_grad():
            bias.fill_(value)
        average.update(network, update)
        expected += (1 - min(decay, (1 + update) / (10 + update))) * (value - expected)
    assert float(average.network.state_dict()["net.pred.conv2d.bias"]) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_the_rate_warms_up_decays_by_epoch_and_may_end_as_a_cosine() -> None:
    plain = OptimizerConfig(learning_rate=0.1, learning_rate_decay=0.5, warmup_steps=4)
    found = [learning_rate(plain, RunConfig(epochs=9), step, epoch) for step, epoch in ((0, 0), (1, 0), (3, 0), (9, 2))]
    assert found == pytest.approx([0.025, 0.05, 0.1, 0.025])
    cosine = OptimizerConfig(learning_rate=0.1, schedule="cosine")
    by_epoch = [learning_rate(cosine, RunConfig(epochs=4), 0, epoch) for epoch in range(5)]
    by_step = [learning_rate(cosine, RunConfig(epochs=4, steps=8), step, 0) for step in (0, 2, 4, 6, 8)]
    assert by_epoch == pytest.approx([0.1, 0.1 * (0.5 + 0.125**0.5), 0.05, 0.1 * (0.5 - 0.125**0.5), 0], abs=1e-9)
    assert by_step == pytest.approx(by_epoch, abs=1e-9)


@pytest.mark.parametrize(("count", "chosen"), [(1, [2]), (2, [0, 2]), (9, [0, 1, 2])])
def test_films_are_of_the_samples_that_move_most(count: int, chosen: list[int]) -> None:
    with FakeServer() as server:
        batch = next(iter(V2VStreamDataset(server.address, batch_size=3, recipe=SPEC.recipe)))
    moving = torch.zeros(3, 4, 1, 8, 8, dtype=torch.uint8)
    moving[0, 2], moving[2, 1] = 100, 200
    noise = torch.randint(-9, 9, (3, 4, 5, 8, 8), dtype=torch.int8)  # events of noise are no motion
    assert liveliest(dataclasses.replace(batch, arrays={"voxels": noise, "frames": moving}), count) == chosen
    assert liveliest(dataclasses.replace(batch, arrays={"voxels": noise}), count) == [0, 1, 2][:count]


# --- a clean end ------------------------------------------------------------------------------------------------------


def signalling(at: int, *, number: int = signal.SIGINT, then_wait: bool) -> Iterator[int]:
    """0, 1, 2 ...; before item ``at`` a signal comes, and then, if asked, nothing ever."""
    for item in range(100):
        if item == at:
            os.kill(os.getpid(), number)
            while then_wait:
                signal.pause()
        yield item


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_for_data_and_handlers_are_restored(number: int) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        taken = list(stop.until(signalling(3, number=number, then_wait=True)))
    assert taken == [0, 1, 2]
    assert stop.signal == number
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_signal_within_a_step_lets_it_finish() -> None:
    finished = []
    with StopRequest() as stop:
        for item in stop.until(range(10)):
            if item == 4:
                os.kill(os.getpid(), signal.SIGINT)
            finished.append(item)
    assert finished == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("launched", [False, True])
def test_the_second_signal_takes_effect_immediately_and_the_third_under_torchrun(
    launched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    if launched:
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    signals = []

    def steps() -> None:
        with StopRequest() as stop:
            for _ in stop.until(range(10)):
                for number in range(3):
                    signals.append(number)
                    os.kill(os.getpid(), signal.SIGINT)

    # Its default action would end this process, so Python's own stands in for it.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signal, "SIG_DFL", signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            steps()
    assert len(signals) == 2 + launched


def test_any_rank_stops_all_ranks_before_the_next_step() -> None:
    votes = iter([False, False, True])
    with StopRequest(agree=lambda mine: next(votes) or mine) as stop:
        assert list(stop.until(range(10))) == [0, 1]
    assert not stop.wanted


def test_ranks_vote_in_every_round_including_the_last() -> None:
    """Ranks that end and ranks that stop meet in the same vote, or one would wait for ever."""
    votes: list[bool] = []

    def agree(mine: bool) -> bool:
        votes.append(mine)
        return mine

    with StopRequest(agree=agree) as stop:
        list(stop.until(range(3)))
    assert votes == [False] * 4
    votes.clear()
    with StopRequest(agree=agree) as stop:
        list(stop.until(signalling(1, then_wait=True)))
    assert votes == [False, True]


def test_a_time_limit_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    taken = []
    with StopRequest(seconds=5) as stop:
        for item in stop.until(range(100)):
            taken.append(item)
            now[0] += 2
    assert taken == [0, 1, 2]
    assert stop.signal == 0


@pytest.mark.parametrize("error", [ServerLost("gone"), StateMismatch("other videos"), WorkerCrashLoop("no worker")])
def test_the_reason_why_the_data_ended_is_kept(error: V2VError) -> None:
    def items() -> Iterator[int]:
        yield 0
        raise error

    with StopRequest() as stop:
        assert list(stop.until(items())) == [0]
    assert stop.failure is error


@pytest.mark.parametrize(
    "error", [RuntimeError("DataLoader worker (pid 7) exited unexpectedly"), EOFError(), ConnectionResetError("gone")]
)
def test_loader_workers_ended_by_the_same_signal_are_not_an_error(error: Exception) -> None:
    def items(number: int) -> Iterator[int]:
        yield 0
        try:
            if number:
                os.kill(os.getpid(), number)
        finally:
            raise error

    with StopRequest() as stop:
        assert list(stop.until(items(signal.SIGTERM))) == [0]
    assert stop.signal == signal.SIGTERM
    with StopRequest() as stop, pytest.raises(type(error)):
        list(stop.until(items(0)))


# --- ranks -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def at_the_end(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], None]]:
    """Make this process the second of two ranks. What is in the list is called when their group is destroyed."""
    called: list[Callable[[], None]] = []
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr("torch.distributed.init_process_group", lambda *_, **__: None)
    monkeypatch.setattr("torch.distributed.get_rank", lambda: 1)
    monkeypatch.setattr("torch.distributed.destroy_process_group", lambda: [each() for each in called])
    return called


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_rank_with_an_error_does_not_wait_for_the_others(
    at_the_end: list[Callable[[], None]], error: type[BaseException] | None
) -> None:
    left: list[bool] = []
    at_the_end.append(lambda: left.append(True))
    with pytest.raises(error) if error else nullcontext(), ranks("cpu", 60.0) as mine:
        assert (mine.rank, mine.world_size) == (1, 2)
        if error:
            raise error
    assert left == ([] if error else [True])


def test_the_process_group_is_destroyed_after_training(at_the_end: list[Callable[[], None]]) -> None:
    """A model of several ranks knows its group, and lies in a circle of references."""

    class Model:
        def __init__(self) -> None:
            self.myself = self

    def trained() -> weakref.ref[Model]:
        return weakref.ref(Model())

    known: list[Model | None] = []
    gc.disable()  # not by chance
    try:
        with ranks("cpu", 60.0):
            model = trained()
            at_the_end.append(lambda: known.append(model()))
            assert model() is not None
    finally:
        gc.enable()
    assert known == [None]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_reported() -> None:
    with pytest.raises(UsageError, match=r"compute\.device = cuda: PyTorch sees no GPU"), ranks("cuda", 60.0):
        pass


TINY = {name: getattr(SPEC.recipe, name) for name in ("voxels_per_clip", "bins", "crop_height_px", "crop_width_px")}


def test_a_run_trains_on_the_batches_of_its_streams() -> None:
    with FakeServer(sequences=40, spec=SPEC) as one, FakeServer(sequences=40, spec=SPEC) as other:
        one.catalogue, other.catalogue = "one", "other"
        mix = [{"weight": 0.25, "address": other.address}]
        settings = StreamConfig(address=one.address, batch_size=4, recipe=TINY, mix=mix)
        config, asked = TrainConfig(stream=settings), Asked(arrays=("voxels", "frames"))
        dataset = streams(config, asked, [one.address, other.address])
        batches = list(dataset)
        assert len(batches) == len(dataset) == 13
        assert sum(each.provenance[0].id.catalogue_digest == "other" for each in batches) == 3
        assert _planned_steps(dataset, config) == 13
