"""Server, workers' conversations and consumers over plain queues: the loop, the dispatcher and the supervisor's seam as
they are, and no socket, process or clock. The promise holds for any interleaving of the three."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from tests.server.named_corpus import SMALL_SPEC, corpus, video
from tests.server.peers import DEADLINE, answer_to
from tests.server.queues import Queues, ToyPool
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import VideoError
from v2v_protocol.link.router import FromWorker
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    Hello,
    Lease,
    Result,
    SampleHeader,
    Unavailable,
    Want,
    Welcome,
    WorkerHello,
)
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.leases import Cause
from v2v_server.broker.state import Broker
from v2v_server.config import ServeConfig
from v2v_server.quarantine import read_quarantine
from v2v_server.serve import Server
from v2v_server.worker.conversation import (
    CREDIT,
    Inspect,
    Leave,
    Listen,
    Load,
    Make,
    Readiness,
    Send,
    WorkerAction,
    WorkerConversation,
)

WORKERS = 2
FAILING = "v1.mp4"


@dataclass
class Consumer:
    """Asks, and asks again when the server has forgotten it.

    Attributes:
        owed: asked and not answered.
        samples: answered with a sample, and how often.
        greets: it waits for a welcome.
    """

    identity: bytes
    queues: Queues
    credit: int = 0
    owed: set[int] = field(default_factory=set)
    samples: Counter[int] = field(default_factory=Counter)
    greets: bool = False

    def say_hello(self) -> None:
        self.greets = True
        self.queues.consumer_says(self.identity, Hello({}, ("voxels",), 4, 7))

    def ask(self, indices: set[int]) -> None:
        self.owed |= indices
        if not self.greets:  # all that is owed is asked for once it is welcome
            self.queues.consumer_says(self.identity, Want(0, tuple(sorted(indices))))

    def listen(self) -> None:
        for message in self.queues.take(self.identity):
            match message:
                case Welcome():
                    self.credit, self.greets = message.credit, False
                    self.ask(self.owed)
                case Denied(ErrorCode.UNKNOWN_SESSION):
                    if not self.greets:
                        self.say_hello()
                case SampleHeader():
                    self.owed.remove(message.index)  # nothing comes that is not waited for
                    self.samples[message.index] += 1
                case Unavailable():
                    self.owed.remove(message.index)
                case _:
                    raise AssertionError(message)


class Worker:
    """A conversation whose steps are taken one at a time."""

    def __init__(self, name: bytes, world: World) -> None:
        self.name, self.world = name, world
        self.kernels = False
        hello = WorkerHello(name.decode(), NUMERICS_VERSION, CREDIT)
        self.conversation = WorkerConversation(hello, ("queue://workers",), is_watched=True)
        self.step: WorkerAction = Leave()
        world.queues.connect(name)
        self._take(self.conversation.start(world.now))

    def _take(self, actions: list[WorkerAction]) -> None:
        *said, self.step = actions
        for action in said:
            if isinstance(action, Send):
                self.world.queues.worker_says(self.name, action.frames)
        if isinstance(self.step, Leave):
            self.world.end(self.name)

    def go_on(self) -> None:
        """Takes the next step."""
        match self.step:
            case Listen():
                inbox = self.world.queues.sent[self.name]
                messages = [(0, frames[0]) for frames in inbox]
                inbox.clear()
                self._take(self.conversation.on_messages(messages, self.world.now))
            case Inspect(lease):
                place = lease.indices[0]
                readiness = Readiness(self.kernels or place % 5 != 0, place % 2 == 0, place % 3 == 0)
                self._take(self.conversation.on_inspected(readiness, self.world.now))
            case Load():
                self.kernels = True
                self._take(self.conversation.on_kernels_loaded(self.world.now))
            case Make(lease):
                if lease.video == FAILING:
                    error = VideoError(lease.video, 3, "cut short")
                    self._take(self.conversation.on_failure(error, self.world.now))
                else:
                    self._take(self.conversation.on_sample(self.frames(lease), self.world.now, Result(0)))

    @staticmethod
    def frames(lease: Lease) -> list[Any]:
        return list(answer_to(lease))


class World:
    """A server and everybody who talks to it, under one clock."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now = 1000.0
        self.queues = Queues()
        self.workers: dict[bytes, Worker] = {}
        self.consumers = {name: Consumer(name, self.queues) for name in (b"c", b"d")}
        self.started = 0
        self.start()

    def start(self) -> None:
        """A new server in the place of the last. What workers had said waits for it; all else is lost."""
        videos = corpus(*(video(f"v{number}.mp4") for number in range(5)))
        file = self.folder / "quarantine.jsonl"
        quarantine = read_quarantine(file)
        broker = Broker(
            videos.facts,
            SMALL_SPEC,
            lease_deadline_seconds=DEADLINE,
            session_idle_seconds=600.0,
            max_credit_bytes=2 << 30,
            quarantine=quarantine,
            wall_clock=lambda: "2024-02-29T12:00:00+00:00",
        )
        self.dispatcher = Dispatcher(broker)
        self.supervisor = ToyPool(lambda name, address: self._begin(name))
        self.supervisor.workers = list(self.workers)  # they find the new server at the same address
        self.server = Server(
            ServeConfig(videos="videos", workers=WORKERS),
            videos,
            self.dispatcher,
            self.queues,
            self.supervisor,
            file,
            clock=lambda: self.now,
        )
        self.supervisor.start(self.queues.worker_address)
        self.supervisor.scale(WORKERS)
        self.queues.arrived = deque(one for one in self.queues.arrived if isinstance(one, FromWorker))
        for inbox in self.queues.sent.values():
            inbox.clear()
        for consumer in self.consumers.values():
            self.queues.connect(consumer.identity)
            consumer.say_hello()

    def _begin(self, name: bytes) -> None:
        self.started += 1
        name = f"{name.decode()}.{self.started}".encode()
        self.supervisor.workers[-1] = name
        self.workers[name] = Worker(name, self)

    def end(self, name: bytes) -> None:
        """That worker is gone, and its supervisor starts another."""
        self.workers.pop(name, None)
        self.queues.sent.pop(name, None)
        if name in self.supervisor.workers:
            self.supervisor.workers.remove(name)

    def turn(self) -> None:
        self.server.turn(0.0)
        for name in set(self.workers) - set(self.supervisor.workers):
            self.end(name)  # its supervisor gave it up

    def settle(self) -> None:
        """Run all peers until none waits for anything."""
        for _ in range(20_000):
            self.turn()
            for worker in list(self.workers.values()):
                worker.go_on()
            for consumer in self.consumers.values():
                consumer.listen()
            if not any(consumer.owed for consumer in self.consumers.values()):
                return
            self.now += 0.05
        raise AssertionError({name: consumer.owed for name, consumer in self.consumers.items()})


class AnyOrder(RuleBasedStateMachine):
    """Messages are taken and steps are made in any order; workers die, hang and leave; the server restarts."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.world = World(self.folder)
        self.hung: set[bytes] = set()

    def _worker(self, which: int) -> Worker | None:
        names = sorted(set(self.world.workers) - self.hung)
        return self.world.workers[names[which % len(names)]] if names else None

    @rule(turns=st.integers(1, 6))
    def server_turns(self, turns: int) -> None:
        for _ in range(turns):
            self.world.turn()
            self.world.now += 0.03

    @rule(which=st.integers(0, 3), steps=st.integers(1, 5))
    def worker_goes_on(self, which: int, steps: int) -> None:
        for _ in range(steps):
            if (worker := self._worker(which)) is not None:
                worker.go_on()

    @rule(identity=st.sampled_from((b"c", b"d")))
    def consumer_listens(self, identity: bytes) -> None:
        self.world.consumers[identity].listen()

    @rule(identity=st.sampled_from((b"c", b"d")), first=st.integers(0, 40), count=st.integers(1, 4))
    def consumer_asks(self, identity: bytes, first: int, count: int) -> None:
        consumer = self.world.consumers[identity]
        indices = set(range(first, first + count)) - set(consumer.samples) - consumer.owed
        if indices and len(consumer.owed | indices) <= consumer.credit:
            consumer.ask(indices)

    @rule(which=st.integers(0, 3), cause=st.sampled_from(list(Cause)))
    def worker_dies(self, which: int, cause: Cause) -> None:
        if (worker := self._worker(which)) is not None and worker.name in self.world.supervisor.workers:
            self.world.supervisor.kill(worker.name, cause)
            self.world.end(worker.name)

    @rule(which=st.integers(0, 3))
    def worker_hangs(self, which: int) -> None:
        if (worker := self._worker(which)) is not None:
            self.hung.add(worker.name)

    @rule(which=st.integers(0, 3))
    def worker_is_told_to_leave(self, which: int) -> None:
        if (worker := self._worker(which)) is not None:
            worker.conversation.stop()

    @rule(seconds=st.sampled_from((1.0, 10.0, DEADLINE + 1)))
    def time_passes(self, seconds: float) -> None:
        self.world.now += seconds

    @precondition(lambda self: self.world.dispatcher.broker.counters.samples)
    @rule()
    def server_restarts(self) -> None:
        assert self.world.dispatcher.broker.counters.malformed == 0
        self.world.start()

    def teardown(self) -> None:
        for name in self.hung & set(self.world.workers):
            if name in self.world.supervisor.workers:
                self.world.supervisor.kill(name, Cause.KILLED)
            self.world.end(name)
        self.world.settle()
        for consumer in self.world.consumers.values():
            assert all(times == 1 for times in consumer.samples.values())
        assert self.world.dispatcher.broker.waiting == 0
        assert self.world.dispatcher.broker.counters.malformed == 0  # nothing that a conversation says is nonsense
        shutil.rmtree(self.folder)


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=25, stateful_step_count=50, deadline=None)


def walk(seed: int) -> Counter[str]:
    """The same rules in a drawn order that keeps everybody at work.

    Returns:
        how often the states came about that the rules are there for.
    """
    draw = random.Random(seed)
    model = AnyOrder()
    moves: dict[str, tuple[float, Callable[[], object]]] = {
        "turn": (30, lambda: model.server_turns(draw.randrange(1, 7))),
        "step": (40, lambda: model.worker_goes_on(draw.randrange(4), draw.randrange(1, 6))),
        "listen": (10, lambda: model.consumer_listens(draw.choice((b"c", b"d")))),
        "ask": (10, lambda: model.consumer_asks(draw.choice((b"c", b"d")), draw.randrange(40), 4)),
        "die": (2, lambda: model.worker_dies(draw.randrange(4), draw.choice(list(Cause)))),
        "hang": (0.5, lambda: model.worker_hangs(draw.randrange(4))),
        "leave": (1, lambda: model.worker_is_told_to_leave(draw.randrange(4))),
        "time": (2, lambda: model.time_passes(draw.choice((1.0, 10.0, DEADLINE + 1)))),
        "restart": (2, model.server_restarts),
    }
    weights = [weight for weight, _ in moves.values()]
    seen: Counter[str] = Counter()
    for name in draw.choices(list(moves), weights, k=300):
        if name == "restart":
            at_work = any(isinstance(worker.step, Make) for worker in model.world.workers.values())
            seen["restarted while samples are made"] += at_work
            counters = model.world.dispatcher.broker.counters
            seen["refused"] += counters.refused_candidates
            seen["lost"] += counters.workers_lost
        moves[name][1]()
    model.teardown()
    seen["samples"] = sum(len(consumer.samples) for consumer in model.world.consumers.values())
    return seen


def test_long_walks_keep_the_promise_and_reach_what_is_rare() -> None:
    seen = sum(map(walk, range(40)), Counter())
    least = {"restarted while samples are made": 15, "refused": 100, "lost": 100, "samples": 800}
    assert {name: seen[name] for name in least if seen[name] < least[name]} == {}
