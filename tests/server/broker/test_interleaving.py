"""The promise against any interleaving: consumers and workers that come, go, die, hang, fail, repeat themselves and are
late, on a server whose quarantine can sometimes not be written, and whose index is at times locked or damaged."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Mapping, Set

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.server.named_corpus import corpus, video
from tests.server.peers import CREDIT, DEADLINE, peers, sample_frames
from v2v_client.memory import Slots
from v2v_protocol.arena import NO_SLOT, ArenaName, Slot
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    Goodbye,
    Lease,
    LeaseFailed,
    Ping,
    Result,
    SampleHeader,
    Unavailable,
    decode_map,
)
from v2v_server.broker.assignment import TOO_LARGE_SECONDS
from v2v_server.broker.leases import Cause, runs_alone

_HALF_WRITTEN = (-1, -1, -1)
VIDEOS = tuple(f"v{number}.mp4" for number in range(5))


class Interleaving(RuleBasedStateMachine):
    """Whatever happens in whatever order, once healthy workers are left to finish, every index that a consumer waits
    for has been answered exactly once, and no message without a recipient is left."""

    spec: Mapping[str, int] = {}
    share_bytes = 0
    consumers = st.sampled_from((b"c", b"d"))
    names = st.sampled_from((b"w1", b"w2", b"w3", b"w4"))

    @initialize(
        remote=st.sets(names),
        lethal=st.dictionaries(st.sampled_from(("v0.mp4", "v1.mp4")), st.sampled_from(list(Cause)), min_size=1),
        damaged=st.sets(st.just("v2.mp4")),
    )
    def start(self, remote: set[bytes], lethal: dict[str, Cause], damaged: Set[str] = frozenset()) -> None:
        """A server at work: it is known how long samples usually take, two consumers have asked for more, and two
        workers are there.

        Args:
            remote: workers whose processes cannot be ended.
            lethal: videos that end the worker that begins one, and how it ends; a hung one stays silent.
            damaged: videos whose index is damaged.
        """
        self.locked: set[str] = set()
        videos = corpus(*map(video, VIDEOS), unreadable=tuple(damaged), held=self.locked)
        self.at = peers(videos, share_bytes=self.share_bytes)
        self.at.remote = remote
        self.lethal = lethal
        self.stuck: set[bytes] = set()
        self.owed: dict[bytes, set[tuple[int, int]]] = {}
        self.credit: dict[bytes, int] = {}
        self.read: dict[bytes, int] = {}
        self.seed: dict[bytes, int] = {}
        self.late: list[tuple[bytes, Lease]] = []
        self.join(b"w1", CREDIT)
        for identity in (b"c", b"d"):
            self.connect(identity, 4, None)
            self.ask(identity, 0, list(range(8)))
        while self.at.leases[b"w1"]:
            self.at.begin(b"w1")
            self.answer(b"w1")
        self._listen()
        for identity in (b"c", b"d"):
            self.ask(identity, 0, list(range(8, 14)))
        self.join(b"w2", CREDIT)

    def _listen(self) -> None:
        """Deliver to each consumer; workers that the server does not know clear their leases and say hello again."""
        for identity, heard in self.at.heard.items():
            for number, message in enumerate(heard[self.read.get(identity, 0) :], self.read.get(identity, 0)):
                if isinstance(message, SampleHeader):
                    self.receive_sample(identity, message, in_message=len(self.at.frames[identity][number]) > 1)
                if isinstance(message, SampleHeader | Unavailable):
                    # The heart of the promise: nothing comes that is not waited for.
                    self.owed[identity].remove((message.epoch, message.index))
                    if isinstance(message, SampleHeader):
                        assert decode_map(message.provenance) == {"seed": self.seed[identity]}
            self.read[identity] = len(heard)
        while self.at.given_up:
            # Those of this host are killed. The others are out of reach, and say something later.
            identity = self.at.given_up.pop()
            if identity not in self.at.remote:
                self.stuck.discard(identity)
                self.late += [(identity, lease) for lease in self.at.leases.pop(identity, ())]
        unknown: list[bytes] = []
        for identity, told in self.at.told.items():
            for message in told:
                if isinstance(message, Denied) and identity in self.at.leases:
                    assert message.code == ErrorCode.UNKNOWN_SESSION
                    unknown.append(identity)
            told.clear()
        for identity in unknown:
            self.at.join(identity)
        if unknown:  # a worker that joins may bring a waiting consumer its sample at once
            self._listen()

    # What a consumer and a worker do about slots: nothing, here.

    def want(self, identity: bytes, epoch: int, indices: list[int]) -> None:
        self.at.want(*indices, identity=identity, epoch=epoch)

    def receive_sample(self, identity: bytes, header: SampleHeader, *, in_message: bool) -> None:
        assert in_message
        assert header.slot == NO_SLOT

    def answer(self, identity: bytes) -> Lease:
        return self.at.finish(identity)

    def fail(self, identity: bytes, *, here: bool = False) -> Lease:
        return self.at.fail(identity, here=here)

    @rule(identity=consumers, batch_size=st.integers(1, 4), pinned=st.none() | st.integers(0, 3))
    def connect(self, identity: bytes, batch_size: int, pinned: int | None) -> None:
        """Connects, or connects again and asks again for what it still lacks, as far as its new credit goes."""
        self.seed[identity] = self.seed.get(identity, 0) + 1
        snapshot = None if pinned is None else min(pinned, self.at.quarantine.latest)
        welcome = self.at.hello(
            identity, batch_size=batch_size, seed=self.seed[identity], quarantine=snapshot, **self.spec
        )
        assert welcome.quarantine == (self.at.quarantine.latest if snapshot is None else snapshot)
        self.credit[identity] = welcome.credit
        self._listen()
        lacking = sorted(self.owed.get(identity, ()))[: welcome.credit]
        self.owed[identity] = set(lacking)
        for epoch, index in lacking:
            refusals = len(self.at.refusals(identity))
            self.want(identity, epoch, [index])
            assert len(self.at.refusals(identity)) == refusals
        self._listen()

    @rule(identity=consumers, how=st.sampled_from(("goodbye", "unreachable")))
    def leave(self, identity: bytes, how: str) -> None:
        if how == "goodbye":
            self.at.consumer_says(identity, Goodbye())
        else:
            self.at.dispatcher.consumer_lost(identity)
        self.owed.pop(identity, None)
        self._listen()

    @rule(identity=consumers, epoch=st.integers(0, 1), indices=st.lists(st.integers(0, 49), max_size=6))
    def ask(self, identity: bytes, epoch: int, indices: list[int]) -> None:
        if identity not in self.owed:
            return
        wanted = self.owed[identity] | {(epoch, index) for index in indices}
        within = len(wanted) <= self.credit[identity]
        if within:
            self.owed[identity] = wanted
        refusals = len(self.at.refusals(identity))
        self.want(identity, epoch, indices)
        assert len(self.at.refusals(identity)) == refusals + (not within)
        self._listen()

    @rule(identity=consumers)
    def ask_again(self, identity: bytes) -> None:
        """A consumer that is not sure whether it was heard: no index is made twice for it."""
        for epoch, index in sorted(self.owed.get(identity, ())):
            self.want(identity, epoch, [index])
        self._listen()

    @rule(identity=names, credit=st.sampled_from((1, CREDIT, CREDIT)))
    def join(self, identity: bytes, credit: int) -> None:
        """A new worker, or one that says hello again while it is known: what it held it may still answer."""
        self.late += [(identity, lease) for lease in self.at.leases.get(identity, ())]
        self.stuck.discard(identity)
        self.at.join(identity, credit)
        self._listen()

    def _busy(self) -> list[bytes]:
        return sorted(identity for identity, held in self.at.leases.items() if held and identity not in self.stuck)

    def _begin(self, identity: bytes) -> bool:
        """Whether the worker lives to make the sample."""
        cause = self.lethal.get(self.at.begin(identity).video)
        if cause is Cause.HUNG:
            self.stuck.add(identity)
        elif cause is not None:
            self.late += [(identity, lease) for lease in self.at.die(identity, cause)]
            self._listen()
        return cause is None

    @precondition(lambda self: self._busy())
    @rule(which=st.integers(0, 3), what=st.sampled_from(("begin", "finish", "finish", "fail", "miss")))
    def work(self, which: int, what: str) -> None:
        identity = self._busy()[which % len(self._busy())]
        if what == "begin":
            self._begin(identity)
            return
        lease = self.answer(identity) if what == "finish" else self.fail(identity, here=what == "miss")
        self.late.append((identity, lease))
        self._listen()

    @precondition(lambda self: self._busy() and self.owed)
    @rule(which=st.integers(0, 3), samples=st.integers(1, 24))
    def get_on(self, which: int, samples: int) -> None:
        """A stretch of work without trouble but for what is lethal: the consumers ask for more as they are served, and
        in time it is known what is usual."""
        for number in range(samples):
            consumer = sorted(self.owed)[number % len(self.owed)]
            self.ask(consumer, 1, [(len(self.at.heard[consumer]) + number) % 50])
            busy = self._busy()
            if not busy:
                return
            identity = busy[which % len(busy)]
            if self._begin(identity):
                self.answer(identity)
                self._listen()

    @rule(identities=st.sets(names, min_size=1), credit=st.sampled_from((1, CREDIT)))
    def replenish(self, identities: set[bytes], credit: int) -> None:
        """New workers in the place of those that are gone."""
        for identity in sorted(identities - set(self.at.leases)):
            self.join(identity, credit)

    @rule(identity=names, cause=st.sampled_from(list(Cause)), began=st.booleans())
    def die(self, identity: bytes, cause: Cause, began: bool) -> None:
        if began and identity in self._busy():
            self.at.begin(identity)
        self.stuck.discard(identity)
        self.late += [(identity, lease) for lease in self.at.die(identity, cause)]
        self._listen()

    @precondition(lambda self: self.at.leases)
    @rule(which=st.integers(0, 3), how=st.sampled_from(("goodbye", "unreachable", "nonsense")))
    def go(self, which: int, how: str) -> None:
        identity = sorted(self.at.leases)[which % len(self.at.leases)]
        held = self.at.leases.pop(identity)
        self.stuck.discard(identity)
        if how == "goodbye":
            self.at.worker_says(identity, Goodbye())
        elif how == "unreachable" or not held:
            self.at.carry_out(self.at.dispatcher.worker_gone(identity, self.at.now))
        else:
            self.at.worker_says(identity, Result(held[0].lease), b"nonsense")
            if self.at.broker.sessions.get(self.at.asked_by(held[0])) is not None:
                self.at.carry_out(self.at.dispatcher.worker_gone(identity, self.at.now))
        self.at.carry_out(self.at.dispatcher.worker_gone(identity, self.at.now))
        self.late += [(identity, lease) for lease in held]
        self._listen()

    @precondition(lambda self: self.late)
    @rule(which=st.integers(0, 99), failed=st.booleans())
    def late_answer(self, which: int, failed: bool) -> None:
        """An answer that was given already, or is to a lease that was taken away."""
        identity, lease = self.late[which % len(self.late)]
        if failed:
            self.at.worker_says(identity, LeaseFailed(lease.lease, None, "late"))
        else:
            self.at.worker_says(identity, Result(lease.lease), *sample_frames(0, lease.indices[0]))
        self._listen()

    @rule(identity=consumers, nbytes=st.sampled_from((0, 1, 1 << 16, 1 << 17, 1 << 40)))
    def in_flight(self, identity: bytes, nbytes: int) -> None:
        """Some of what was sent is not read yet, or again none of it."""
        self.at.carry_out(self.at.dispatcher.in_flight(identity, nbytes, self.at.now))
        self._listen()

    @rule(seconds=st.sampled_from((0.1, 1.5, 10.0, DEADLINE / 2, DEADLINE + 1)))
    def time_passes(self, seconds: float) -> None:
        for identity in self.owed:
            self.at.consumer_says(identity, Ping())
        self.at.tick(seconds)
        self._listen()

    @rule(writable=st.booleans())
    def disk(self, writable: bool) -> None:
        self.at.writable = writable

    @rule(is_locked=st.booleans())
    def index(self, is_locked: bool) -> None:
        """Another process locks the index, or lets it go."""
        self.locked.update(VIDEOS if is_locked else ())
        if not is_locked:
            self.locked.clear()

    @invariant()
    def every_lease_is_sent(self) -> None:
        """And shows the sequence of its candidate."""
        at = getattr(self, "at", None)
        if at is None:
            return
        for identity in at.broker.registry.members:
            held = at.leases.get(identity, ())
            assert at.broker.leases.held.get(identity, []) == sorted(lease.lease for lease in held)
            for lease in held:
                request = at.broker.leases.request(lease.lease, identity)
                if request is not None:
                    assert at.broker.clip_of(request) == (lease.video, lease.start_frame)

    @invariant()
    def bounded(self) -> None:
        at = getattr(self, "at", None)
        if at is None:
            return
        for held in at.leases.values():
            assert len(held) <= CREDIT * self.spec.get("samples_per_decode", 1)
        assert {session.identity for session in at.broker.sessions} == set(self.owed)
        for session in at.broker.sessions:
            assert session.unanswered == self.owed[session.identity]
            assert len(session.unanswered) <= session.credit
            assert 0 <= session.quarantine <= at.quarantine.latest
        assert at.broker.waiting <= sum(map(len, self.owed.values()))

    @invariant()
    def a_lone_request_is_alone(self) -> None:
        at = getattr(self, "at", None)
        if at is None:
            return
        book = at.broker.leases
        for identity in list(at.broker.registry.members):
            lonely = any(runs_alone(request) for request in book.requests_of(identity))
            assert not lonely or book.held_by(identity) == 1

    def teardown(self) -> None:
        if not hasattr(self, "at"):
            return
        self.locked.clear()
        for identity in list(self.at.leases):
            self.at.die(identity)
            self._listen()
        for identity in (b"w1", b"w2", b"w3", b"w4"):
            self.at.die(identity)
        for identity in (b"c", b"d"):
            self.in_flight(identity, 0)
        healthy = (b"healthy", b"also healthy")
        for identity in healthy:
            self.at.join(identity)
        self.at.tick(0.1)  # a locked index is tried again
        while any(self.at.leases[identity] for identity in healthy):
            for identity in healthy:
                if self.at.leases[identity]:
                    self.at.begin(identity)
                    self.answer(identity)
                    self._listen()
        for _ in range(2):  # what takes more memory than any worker has ends as an error
            self.at.tick(TOO_LARGE_SECONDS)
            self._listen()
        assert not any(self.owed.values())
        assert self.at.broker.waiting == 0
        assert not self.at.broker.parked
        assert len(self.at.broker.leases) == 0
        assert not self.at.broker.leases.held
        assert not self.at.broker.leases.out
        assert set(self.at.broker.leases.durations) <= set(self.owed)


class OfSiblings(Interleaving):
    """The same with two samples of each decode, neighbours but one."""

    spec = {"samples_per_decode": 2, "sibling_spacing": 2}  # noqa: RUF012


# Few: the long walks below take the same rules much further. These explain a failure by its shortest example.
TestInterleavingOfSiblings = OfSiblings.TestCase
TestInterleavingOfSiblings.settings = settings(max_examples=20, stateful_step_count=50, deadline=None)


class WithSlots(Interleaving):
    """The same with consumers that lend slots, and workers that may write to what they were ever lent until they have
    answered: no consumer ever reads anything but its sample, nor lends an arena again that anybody may write to."""

    def __init__(self) -> None:
        super().__init__()
        self.slots: dict[bytes, Slots] = {}
        self.memory: dict[tuple[str, int], tuple[int, int, int]] = {}
        self.lent: dict[int, Lease] = {}  # the lease of each worker that may still write, by number
        self.expected: dict[str, set[int]] = {}  # slots of each arena that were named and not given back
        self.unused: list[str] = []
        self.arenas = 0
        self.read_there = 0
        self.abandoned = 0
        self.used_again = 0

    def _arena(self) -> str:
        if self.unused:
            self.used_again += 1
            return self.unused.pop()
        self.arenas += 1
        return str(ArenaName(1, self.arenas, 20, "0123456789abcdef" * 2))

    def want(self, identity: bytes, epoch: int, indices: list[int]) -> None:
        slots = self.slots.setdefault(identity, Slots())
        session = self.at.broker.sessions.get(identity)
        keys = {epoch * 1000 + index: index for index in indices}
        fresh = {key: index for key, index in keys.items() if key not in slots._named}
        if session is None or len(session.unanswered | {(epoch, index) for index in indices}) > session.credit:
            super().want(identity, epoch, indices)  # refused as a whole, which no client of ours lets happen
            return
        super().want(identity, epoch, [index for key, index in keys.items() if key not in fresh])
        if fresh:
            arena = self._arena()
            numbers = list(range(1, len(fresh) + 1))
            self.expected[arena] = set(numbers)
            slots.offer({key: Slot(arena, number) for key, number in zip(fresh, numbers, strict=True)})
            slots.want(epoch, list(fresh))
            self.at.want(*fresh.values(), identity=identity, epoch=epoch, arena=arena, slots=numbers)

    def receive_sample(self, identity: bytes, header: SampleHeader, *, in_message: bool) -> None:
        slots = self.slots[identity]
        key = header.epoch * 1000 + header.index
        slot = slots._named.get(key)
        slot_is_free = slots.record_arrival(key, header.slot, in_message=in_message)
        assert slot_is_free is not None
        self.abandoned += not slot_is_free
        if not in_message:
            assert slot is not None
            self.read_there += 1
            place = (slot.arena, slot.number)
            assert place not in {(lease.arena, lease.slot) for lease in self.lent.values()}, "it may change as we read"
            assert self.memory[place] == (header.epoch, header.index, self.seed[identity])
        if slot is not None and slot_is_free:
            self.expected[slot.arena].discard(slot.number)
            if not self.expected[slot.arena]:
                assert slot.arena not in {lease.arena for lease in self.lent.values()}, "its next batch may change"
                self.unused.append(slot.arena)

    def _note_leases(self) -> None:
        for held in self.at.leases.values():
            self.lent |= {lease.lease: lease for lease in held if lease.slot != NO_SLOT}

    def answer(self, identity: bytes) -> Lease:
        self._note_leases()
        lease = self.at.leases[identity][0]
        if lease.slot == NO_SLOT or lease.lease % 7 == 0:  # some cannot reach it
            self.lent.pop(lease.lease, None)
            return self.at.finish(identity)
        self.memory[lease.arena, lease.slot] = (lease.epoch, lease.indices[0], lease.seed)
        del self.lent[lease.lease]
        return self.at.finish(identity, in_slot=True)

    def fail(self, identity: bytes, *, here: bool = False) -> Lease:
        self._note_leases()
        lease = super().fail(identity, here=here)
        self.lent.pop(lease.lease, None)
        return lease

    @rule(which=st.integers(0, 99))
    def late_write(self, which: int) -> None:
        """Half a sample, of a worker that may have been given up long ago."""
        self._note_leases()
        if self.lent:
            lease = self.lent[sorted(self.lent)[which % len(self.lent)]]
            self.memory[lease.arena, lease.slot] = _HALF_WRITTEN

    def _listen(self) -> None:
        self._note_leases()
        super()._listen()


TestInterleavingWithSlots = WithSlots.TestCase
TestInterleavingWithSlots.settings = settings(max_examples=40, stateful_step_count=50, deadline=None)


# --- long walks -------------------------------------------------------------------------------------------------------


def walk(seed: int, steps: int, kind: type[Interleaving] = Interleaving) -> Counter[str]:
    """The same rules in a drawn order that keeps the server at work, so that rare states are reached.

    Returns:
        how often the states came about that the rules are there for.
    """
    draw = random.Random(seed)
    names = (b"w1", b"w2", b"w3", b"w4")
    model = kind()
    lethal = {"v0.mp4": draw.choice(list(Cause)), "v1.mp4": draw.choice((Cause.UNEXPLAINED, Cause.HUNG))}
    model.start(set(draw.sample(names, draw.randrange(3))), lethal, set(draw.sample(VIDEOS[2:], draw.randrange(2))))
    seen: Counter[str] = Counter()

    def who() -> bytes:
        return draw.choice((b"c", b"d"))

    moves: dict[str, tuple[float, Callable[[], object]]] = {
        "get_on": (12, lambda: model._busy() and model.owed and model.get_on(draw.randrange(4), draw.randrange(1, 24))),
        "work": (
            30,
            lambda: model._busy() and model.work(draw.randrange(4), draw.choice(("begin", "finish", "fail", "miss"))),
        ),
        "ask": (8, lambda: model.ask(who(), draw.randrange(2), draw.sample(range(50), draw.randrange(6)))),
        "time_passes": (15, lambda: model.time_passes(draw.choice((0.1, 1.5, 2.0, 3.0, 3.0, 20.0, 61.0)))),
        "replenish": (15, lambda: model.replenish({draw.choice(names)}, draw.choice((1, CREDIT)))),
        "late_answer": (5, lambda: model.late and model.late_answer(draw.randrange(100), draw.random() < 0.3)),
        "die": (4, lambda: model.die(draw.choice(names), draw.choice(list(Cause)), draw.random() < 0.7)),
        "join": (2, lambda: model.join(draw.choice(names), CREDIT)),
        "ask_again": (2, lambda: model.ask_again(who())),
        "connect": (2, lambda: model.connect(who(), draw.randrange(1, 5), draw.choice((None, None, 0, 1)))),
        "leave": (0.5, lambda: model.leave(who(), draw.choice(("goodbye", "unreachable")))),
        "go": (2, lambda: model.at.leases and model.go(draw.randrange(4), draw.choice(("unreachable", "nonsense")))),
        "disk": (1, lambda: model.disk(draw.random() < 0.7)),
        "index": (3, lambda: model.index(draw.random() < 0.4)),
    }
    if isinstance(model, WithSlots):
        moves["late_write"] = (10, lambda: model.late_write(draw.randrange(100)))
    weights = [weight for weight, _ in moves.values()]
    for _ in range(steps):
        _, move = draw.choices(list(moves.values()), weights)[0]
        move()
        model.bounded()
        model.every_lease_is_sent()
        model.a_lone_request_is_alone()
        book = model.at.broker.leases
        seen["blocked"] += bool(model.at.broker.blocked_reason)
        seen["lone at work"] += any(map(runs_alone, (request for name in names for request in book.requests_of(name))))
        seen["lone waiting"] += any(runs_alone(clip.requests[0]) for clip in model.at.broker.parked)
    seen["twins"] = model.at.broker.counters.second_leases
    seen["verdicts"] = len(model.at.recorded)
    seen["samples"] = model.at.broker.counters.samples
    if isinstance(model, WithSlots):
        seen["read in slots"] = model.read_there
        seen["abandoned slots"] = model.abandoned
        seen["arenas used again"] = model.used_again
    model.teardown()
    return seen


def test_long_walks_reach_what_is_rare_and_keep_the_promise() -> None:
    seen: Counter[str] = Counter()
    for seed in range(24):
        seen += walk(seed, 150)
    for seed in range(8):
        seen += walk(seed, 150, OfSiblings)
        seen += walk(seed, 150, WithSlots)
    least = {"lone at work": 10, "lone waiting": 3, "twins": 5, "verdicts": 20, "samples": 500, "blocked": 50}
    least |= {"read in slots": 40, "abandoned slots": 5, "arenas used again": 10}
    assert {state: seen[state] for state in least if seen[state] < least[state]} == {}
