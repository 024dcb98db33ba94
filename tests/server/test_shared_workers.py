"""Two brokers that share their workers: real dispatchers, real conversations and plain queues between them. Whatever is
killed, stopped or restarted, each broker answers every index that its consumer waits for, once."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from tests.server.named_corpus import SMALL_SPEC, corpus, video
from tests.server.peers import DEADLINE, Peers, answer_to, peers
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import KeyRefused, ProtocolError
from v2v_protocol.messages import (
    Begun,
    Denied,
    Frames,
    Goodbye,
    Lease,
    Message,
    Notes,
    Ping,
    Pong,
    Result,
    SampleHeader,
    Stop,
    WorkerHello,
    decode,
    encode,
)
from v2v_server.worker.conversation import (
    CREDIT,
    Inspect,
    Leave,
    Listen,
    Load,
    Make,
    Readiness,
    Reconnect,
    Say,
    Send,
    WorkerAction,
    WorkerConversation,
)

ADDRESSES = ("tcp://a", "tcp://b")
HELLO = WorkerHello("w", NUMERICS_VERSION, CREDIT, secret=b"s" * 32, notes=Notes(memory_bytes=8 << 30))


class All(set[bytes]):
    """No broker can end these workers."""

    def __contains__(self, _: object) -> bool:
        return True


@dataclass
class Place:
    """A broker with its consumer, and the connections to it.

    Attributes:
        at: the broker; another one after a restart.
        is_up: whether it takes messages.
        arrived: what workers sent, by the routing id of the connection; it waits for a broker that is down.
        sent: what the broker has sent over each connection.
        owed: indices that the consumer waits for.
        samples: how often each was answered.
    """

    at: Peers
    is_up: bool = True
    arrived: deque[tuple[bytes, Frames]] = field(default_factory=deque)
    sent: dict[bytes, deque[Message]] = field(default_factory=dict)
    owed: set[int] = field(default_factory=set)
    samples: Counter[int] = field(default_factory=Counter)
    restarts: int = 0

    def collect(self) -> None:
        """Pass on what the broker said."""
        self.at.given_up.clear()
        for message in self.at.heard.pop(b"c", []):
            if isinstance(message, SampleHeader):
                self.owed.remove(message.index)  # nothing comes that is not waited for
                self.samples[message.index] += 1
        for identity in self.at.told.keys() | self.at.leases.keys():
            said = [*self.at.told.pop(identity, []), *self.at.leases.pop(identity, [])]
            if identity in self.sent:
                self.sent[identity] += said

    def ask(self, indices: set[int]) -> None:
        self.owed |= indices
        if self.is_up and indices:
            self.at.want(*sorted(indices))
            self.collect()

    def take(self, messages: int) -> None:
        """Handle that many of the messages that have arrived."""
        for _ in range(min(messages, len(self.arrived)) if self.is_up else 0):
            identity, frames = self.arrived.popleft()
            self.at.carry_out(self.at.dispatcher.from_worker(identity, frames, self.at.now))
            self.collect()

    def end(self, *, is_kill: bool) -> None:
        """Stop; what is under way from it is lost, except the word that it stops."""
        for identity, inbox in self.sent.items():
            if is_kill or not self.is_up:
                inbox.clear()
            elif identity in self.at.broker.registry.members:
                inbox.append(Stop())
        self.is_up = False

    def start(self, now: float) -> None:
        """Start again without any memory; the consumer asks again for what it lacks."""
        if not self.is_up:
            self.at, self.is_up, self.restarts = new_broker(now), True, self.restarts + 1
            self.ask(set(self.owed))


def new_broker(now: float) -> Peers:
    at = peers(corpus(*(video(f"v{number}.mp4") for number in range(5))))
    at.now, at.remote = now, All()
    at.hello(batch_size=4)
    at.heard.clear()
    return at


class Worker:
    """A conversation whose steps are taken one at a time.

    Attributes:
        step: what it does next; Leave once it has ended.
        made: the lease numbers that it made, by broker and its restarts.
        told: what it told people.
    """

    def __init__(self, name: str, places: list[Place], now: float) -> None:
        self.name, self.places = name, places
        self.wires = [b"" for _ in places]
        self.connections = 0
        self.kernels = False
        self.made: Counter[tuple[int, int, int]] = Counter()
        self.told: list[str] = []
        self.conversation = WorkerConversation(
            replace(HELLO, name=name, secret=name.encode()), ADDRESSES[: len(places)], is_watched=False
        )
        for broker in range(len(places)):
            self.connect(broker)
        self.step: WorkerAction = Leave()
        self.take(self.conversation.start(now))

    def connect(self, broker: int) -> None:
        place = self.places[broker]
        place.sent.pop(self.wires[broker], None)
        place.arrived = deque(each for each in place.arrived if each[0] != self.wires[broker])
        self.connections += 1
        self.wires[broker] = f"{self.name}.{self.connections}".encode()
        place.sent[self.wires[broker]] = deque()

    def take(self, actions: list[WorkerAction]) -> None:
        *said, self.step = actions
        for action in said:
            match action:
                case Send(frames, broker):
                    self.places[broker].arrived.append((self.wires[broker], frames))
                case Reconnect(broker):
                    self.connect(broker)
                case Say(text):
                    self.told.append(text)

    def go_on(self, now: float) -> None:
        """Take the next step."""
        match self.step:
            case Listen():
                messages = []
                for broker, place in enumerate(self.places):
                    inbox = place.sent[self.wires[broker]]
                    messages += [(broker, encode(message)[0]) for message in inbox]
                    inbox.clear()
                self.take(self.conversation.on_messages(messages, now))
            case Inspect(lease):
                place = lease.indices[0]
                readiness = Readiness(self.kernels or place % 7 != 0, place % 2 == 0, is_decoded=False)
                self.take(self.conversation.on_inspected(readiness, now))
            case Load():
                self.kernels = True
                self.take(self.conversation.on_kernels_loaded(now))
            case Make(lease, broker):
                self.made[broker, self.places[broker].restarts, lease.lease] += 1
                self.take(self.conversation.on_sample(list(answer_to(lease)), now, Result(0)))

    @property
    def held(self) -> list[int]:
        """The number of leases that it holds of each broker."""
        return [len(broker.leases) for broker in self.conversation.brokers]

    def vanish(self) -> None:
        for place, wire in zip(self.places, self.wires, strict=True):
            place.sent.pop(wire, None)


class World:
    """Two brokers and the workers that they share, under one clock."""

    def __init__(self, workers: int = 2) -> None:
        self.now = 1000.0
        self.places = [Place(new_broker(self.now)) for _ in ADDRESSES]
        self.workers: list[Worker] = []
        self.begun = 0
        self.seen: Counter[str] = Counter()
        for _ in range(workers):
            self.add()

    def add(self) -> None:
        self.begun += 1
        self.workers.append(Worker(f"w{self.begun}", self.places, self.now))

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        for place in self.places:
            if place.is_up:
                place.at.consumer_says(b"c", Ping())  # else it is forgotten after ten minutes
                place.at.tick(self.now - place.at.now)
                place.collect()

    def go_on(self, worker: Worker) -> None:
        worker.go_on(self.now)
        if isinstance(worker.step, Leave):
            self.seen["left"] += 1
            self.workers.remove(worker)
            worker.vanish()
            self.add()

    def kill(self, worker: Worker) -> None:
        self.seen["killed"] += 1
        self.workers.remove(worker)
        worker.vanish()
        self.add()

    def settle(self, seconds: float = 2000.0) -> None:
        """Let all go on until no consumer waits. What a killed worker held comes back after its broker's deadline."""
        end = self.now + seconds
        while any(place.owed for place in self.places):
            assert self.now < end, [place.owed for place in self.places]
            for worker in list(self.workers):
                self.go_on(worker)
            for place in self.places:
                place.start(self.now)
                place.take(len(place.arrived))
            self.pass_time(0.05 if any(isinstance(each.step, Make) for each in self.workers) else 1.0)


class Sharing(RuleBasedStateMachine):
    """Messages are taken and steps are made in any order; workers and brokers are killed, stop and come back."""

    def __init__(self) -> None:
        super().__init__()
        self.world = World()

    @rule(which=st.integers(0, 1), first=st.integers(0, 40), count=st.integers(1, 4))
    def ask(self, which: int, first: int, count: int) -> None:
        place = self.world.places[which]
        fresh = set(range(first, first + count)) - set(place.samples) - place.owed
        if len(place.owed | fresh) <= 8:
            place.ask(fresh)

    @rule(which=st.integers(0, 1), messages=st.integers(1, 6))
    def broker_takes(self, which: int, messages: int) -> None:
        self.world.places[which].take(messages)

    @rule(which=st.integers(0, 1), steps=st.integers(1, 6))
    def worker_goes_on(self, which: int, steps: int) -> None:
        for _ in range(steps):
            self.world.go_on(self.world.workers[which])

    @rule(which=st.integers(0, 1))
    def worker_is_killed(self, which: int) -> None:
        self.world.kill(self.world.workers[which])

    @rule(which=st.integers(0, 1))
    def worker_is_told_to_leave(self, which: int) -> None:
        self.world.workers[which].conversation.stop()

    @rule(which=st.integers(0, 1), is_kill=st.booleans())
    def broker_ends(self, which: int, is_kill: bool) -> None:
        self.world.places[which].end(is_kill=is_kill)

    @rule(which=st.integers(0, 1))
    def broker_starts(self, which: int) -> None:
        self.world.places[which].start(self.world.now)

    @rule(seconds=st.sampled_from((0.1, 5.0, 20.0, DEADLINE + 1)))
    def time_passes(self, seconds: float) -> None:
        self.world.pass_time(seconds)

    @invariant()
    def few_leases_are_held(self) -> None:
        for worker in self.world.workers:
            for place, wire, held in zip(self.world.places, worker.wires, worker.held, strict=True):
                assert len(place.at.broker.leases.held.get(wire, ())) <= CREDIT
                assert held <= 2 * CREDIT  # a lease that was under way when the worker said hello again is void
            self.world.seen["work of both"] += min(worker.held) > 0

    def teardown(self) -> None:
        world = self.world
        world.settle()
        for place in world.places:
            assert all(times == 1 for times in place.samples.values())
            assert place.at.broker.waiting == 0
            assert place.at.broker.counters.malformed == 0  # nothing that a conversation says is nonsense
            world.seen["restarted"] += place.restarts
            world.seen["samples"] += len(place.samples)
        for worker in world.workers:
            assert set(worker.made.values()) <= {1}, "a lease was made twice"


TestSharing = Sharing.TestCase
TestSharing.settings = settings(max_examples=20, stateful_step_count=50, deadline=None)


def walk(seed: int) -> Counter[str]:
    """Take the same rules in a drawn order that keeps all at work; return how often rare states came about."""
    draw, model = random.Random(seed), Sharing()
    moves: dict[str, tuple[float, Callable[[], object]]] = {
        "ask": (12, lambda: model.ask(draw.randrange(2), draw.randrange(46), 4)),
        "take": (30, lambda: model.broker_takes(draw.randrange(2), draw.randrange(1, 7))),
        "step": (40, lambda: model.worker_goes_on(draw.randrange(2), draw.randrange(1, 6))),
        "kill": (1.5, lambda: model.worker_is_killed(draw.randrange(2))),
        "leave": (1, lambda: model.worker_is_told_to_leave(draw.randrange(2))),
        "end": (1, lambda: model.broker_ends(draw.randrange(2), draw.random() < 0.5)),
        "start": (3, lambda: model.broker_starts(draw.randrange(2))),
        "time": (3, lambda: model.time_passes(draw.choice((0.1, 5.0, DEADLINE + 1)))),
    }
    weights = [weight for weight, _ in moves.values()]
    for name in draw.choices(list(moves), weights, k=200):
        moves[name][1]()
        model.few_leases_are_held()
    model.teardown()
    return model.world.seen


def test_long_walks_keep_the_promise_and_reach_what_is_rare() -> None:
    seen = sum(map(walk, range(15)), Counter())
    least = {"killed": 30, "left": 20, "restarted": 15, "work of both": 60, "samples": 400}
    assert {name: seen[name] for name in least if seen[name] < least[name]} == {}


# --- the rules, one by one --------------------------------------------------------------------------------------------


def serve_both(world: World, rounds: int) -> list[int]:
    """Let all go on in step; return how many samples each consumer got meanwhile."""
    before = [len(place.samples) for place in world.places]
    for _ in range(rounds):
        for place in world.places:
            if len(place.owed) < 6 and place.samples:
                place.ask({max(place.samples | dict.fromkeys(place.owed)) + 1})
        for worker in list(world.workers):
            world.go_on(worker)
        for place in world.places:
            place.take(len(place.arrived))
    return [len(place.samples) - count for place, count in zip(world.places, before, strict=True)]


def test_each_of_two_brokers_with_work_gets_half() -> None:
    world = World()
    for place in world.places:
        place.ask({1, 2, 3, 4})
    first, second = serve_both(world, 150)
    assert first > 30
    assert abs(first - second) <= 2
    assert [broker.credit for broker in world.workers[0].conversation.brokers] == [1, 1]


@pytest.mark.parametrize("which", [0, 1])
def test_the_only_broker_with_work_gets_all_credit_until_the_other_has_some(which: int) -> None:
    world = World()
    alone, other = world.places[which], world.places[1 - which]
    alone.ask({1, 2, 3, 4, 5, 6})
    serve_both(world, 20)
    credits = [broker.credit for broker in world.workers[0].conversation.brokers]
    assert (credits[which], credits[1 - which]) == (CREDIT, 1)
    members = alone.at.broker.registry.members.values()
    assert [member.credit for member in members] == [CREDIT, CREDIT]
    other.ask({1, 2, 3, 4})
    first, second = serve_both(world, 40)
    assert min(first, second) > 5


def test_siblings_are_made_in_one_go() -> None:
    """Work of the other broker in between would have their clip decoded again."""
    talk = Talk()
    first = replace(LEASE, lease=1, indices=(1, 2))
    talk.hears((0, first), (0, replace(first, lease=2, indices=(2,))), (1, replace(LEASE, lease=9)))
    made = [talk.makes() for _ in range(3)]
    assert made == [(0, 1), (0, 2), (1, 9)]


LEASE = Lease(
    1, SMALL_SPEC.canonical(), "", "", 0, 0, (3,), ("voxels",), "v.mp4", "f", "full", 24, 16, 25.0, (), 0, b"", 0, {}
)


class Talk:
    """One conversation with two brokers, and what it says to each."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.said: list[tuple[int, Message]] = []
        self.told: list[str] = []
        self.conversation = WorkerConversation(HELLO, ADDRESSES, is_watched=False)
        self.step: WorkerAction = Leave()
        self.take(self.conversation.start(self.now))

    def take(self, actions: list[WorkerAction]) -> None:
        *before, self.step = actions
        for action in before:
            if isinstance(action, Send):
                self.said.append((action.broker, decode(action.frames[0])))
            elif isinstance(action, Say):
                self.told.append(action.text)
        if isinstance(self.step, Inspect):
            self.take(self.conversation.on_inspected(Readiness(True, True, False), self.now))

    def hears(self, *messages: tuple[int, Message | Exception]) -> list[tuple[int, Message]]:
        self.said.clear()
        frames = [(at, each if isinstance(each, Exception) else encode(each)[0]) for at, each in messages]
        self.take(self.conversation.on_messages(frames, self.now))
        return list(self.said)

    def makes(self) -> tuple[int, int]:
        """Make the next sample; return its broker and lease."""
        assert isinstance(self.step, Make)
        made = self.step.broker, self.step.lease.lease
        self.take(self.conversation.on_sample([b"header"], self.now, Result(0)))
        self.hears()
        return made


SERVES = Notes(catalogue="c" * 32, spec="s" * 32)
DIFFERENT = {
    "catalogue": (
        Pong(notes=replace(SERVES, catalogue="d" * 32)),
        f"its catalogue is {'d' * 32}, that of tcp://a is {'c' * 32}; start all brokers of a pool with the same",
    ),
    "recipe": (
        Pong(notes=replace(SERVES, spec="t" * 32)),
        f"its default recipe is {'t' * 32}, that of tcp://a is {'s' * 32}",
    ),
    "numerics": (Denied("version", "worker numerics version 3, the server's is 4"), "the server's is 4 [version]"),
    "key": (KeyRefused("tcp://b refuses worker key 'w'"), "refuses worker key 'w'"),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_a_broker_that_differs_is_left_in_words_and_the_other_is_served(what: str) -> None:
    answer, words = DIFFERENT[what]
    talk = Talk()
    assert talk.hears((0, Pong(notes=SERVES)), (1, Pong(notes=SERVES))) == []
    (left,) = [each for each in talk.hears((1, answer)) if isinstance(each[1], Goodbye)]
    assert left[0] == 1
    (line,) = talk.told
    assert line.startswith("tcp://b: ")
    assert words in line
    assert talk.hears((1, replace(LEASE, lease=5))) == [], "its leases are not made"
    assert (0, Begun(7)) in talk.hears((0, replace(LEASE, lease=7)))


def test_a_broker_that_was_refused_is_tried_again_and_named_once() -> None:
    talk = Talk()
    answer, _ = DIFFERENT["recipe"]
    for _ in range(3):
        talk.hears((0, Pong(notes=SERVES)), (1, answer))
        for _ in range(64):  # the other one is served meanwhile
            talk.now += 5.0
            talk.hears((0, Pong(notes=SERVES)))
    assert WorkerHello in [type(message) for broker, message in talk.said if broker == 1]
    assert len(talk.told) == 1
    talk.hears((1, Pong(notes=SERVES)), (1, replace(LEASE, lease=5)))
    assert talk.makes() == (1, 5)


def test_the_first_broker_of_the_list_decides_whoever_is_heard_first() -> None:
    """All workers of a pool leave the same one."""
    talk = Talk()
    talk.hears((1, Pong(notes=SERVES)))
    talk.hears((0, DIFFERENT["catalogue"][0]))
    (line,) = talk.told
    assert line.startswith(f"tcp://b: its catalogue is {'c' * 32}, that of tcp://a is {'d' * 32}")


def test_a_worker_that_no_broker_takes_ends_and_says_why() -> None:
    talk = Talk()
    for broker in (0, 1):
        talk.hears((broker, Denied("version", f"not {broker}")))
    assert talk.step == Leave("not 0 [version]; not 1 [version]")


def test_a_worker_ends_when_all_brokers_have_stopped() -> None:
    talk = Talk()
    talk.hears((0, Stop()))
    assert talk.told == ["tcp://a stops; working for the others"]
    talk.hears((1, replace(LEASE, lease=5)))
    assert talk.makes() == (1, 5)
    talk.hears((1, Stop()))
    assert talk.step == Leave("")


def test_an_idle_broker_is_pinged_while_the_other_keeps_the_worker_busy() -> None:
    """It would forget a worker that it does not hear for 30 s."""
    talk = Talk()
    for number in range(1, 30):
        talk.now += 1.0
        talk.hears((0, replace(LEASE, lease=number)), *([(1, Pong())] if talk.now % 5 == 0 else []))
        talk.makes()
        pings = [message for broker, message in talk.said if broker == 1]
        assert pings == [] or pings == [Ping()]
    assert talk.told == []


def test_a_lease_that_cannot_be_read_costs_only_its_broker() -> None:
    talk = Talk()
    talk.take(talk.conversation.on_messages([(0, b"nonsense"), (1, encode(replace(LEASE, lease=5))[0])], talk.now))
    assert talk.makes() == (1, 5)
    (line,) = talk.told
    assert line.startswith("tcp://a: cannot read a message of the server: not a message")
    with pytest.raises(ProtocolError):
        decode(b"nonsense")
