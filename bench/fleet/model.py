"""A fleet as a discrete-event simulation: workers on hosts, shared storage, trainers with a broker and a network card.

One broker for each trainer host is the unit that scales, so a worker belongs to one trainer. A sample's way: the
trainer asks, a worker reads from the storage and computes on a core of its host, and goes on while the result crosses
the trainer's network card and takes its broker's one thread. What a dying worker had goes to another.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field
from random import Random
from typing import Any

import simpy

Steps = Generator[simpy.Event, Any, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """What one sample costs.

    Attributes:
        worker_seconds: processor time of its worker, while its host has a core to spare.
        crowded_seconds: the same while all cores of the host work: they share caches, memory and, in pairs, units.
        broker_seconds: processor time of the broker.
        client_seconds: processor time of the trainer's process to receive it.
        sample_bytes: over the network.
        video_bytes: from the storage.
    """

    worker_seconds: float
    crowded_seconds: float
    broker_seconds: float = 0.0
    client_seconds: float = 0.0
    sample_bytes: float = 0.0
    video_bytes: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleet:
    """What there is.

    Attributes:
        trainers: hosts with GPUs, a broker each.
        gpus: of a trainer.
        batch_size: of a GPU's step.
        step_seconds: that a GPU computes for a batch; 0: it takes what comes.
        workers: of a trainer.
        cores: of a host of workers.
        workers_per_host: hosts are added until all workers have a place.
        nic_bytes_per_second, storage_bytes_per_second: of a trainer; of all trainers together.
        one_host: brokers and trainers compute on the workers' host too, as in a run on one machine.
        mean_life_seconds: of a worker's process; infinite: none dies.
        notice_seconds: until what a dead worker had is leased again.
        restart_seconds: until a dead worker works again.
        slow_share, slow_factor: so many of the hosts take so many times as long.
    """

    trainers: int = 1
    gpus: int = 1
    batch_size: int = 12
    step_seconds: float = 0.5
    workers: int = 8
    cores: int = 8
    workers_per_host: int = 8
    nic_bytes_per_second: float = math.inf
    storage_bytes_per_second: float = math.inf
    one_host: bool = False
    mean_life_seconds: float = math.inf
    notice_seconds: float = 0.1
    restart_seconds: float = 2.0
    slow_share: float = 0.0
    slow_factor: float = 1.0


@dataclass(slots=True)
class Outcome:
    """What the fleet did in the measured time.

    Attributes:
        samples: that GPUs took.
        seconds: measured.
        waiting_share: of the GPUs' time.
        busy: share of the time that each kind of resource worked: cores, broker, nic, storage.
        deaths: of workers.
        asked, arrived, under_way: samples from the beginning on: asked = arrived + under way, whoever died.
    """

    samples: int
    seconds: float
    waiting_share: float
    busy: dict[str, float]
    deaths: int
    asked: int
    arrived: int
    under_way: int

    @property
    def samples_per_second(self) -> float:
        return self.samples / self.seconds


@dataclass(slots=True)
class _Server:
    """A resource whose busy time is counted."""

    world: simpy.Environment
    capacity: int
    places: simpy.Resource = field(init=False)
    busy_seconds: float = 0.0

    def __post_init__(self) -> None:
        self.places = simpy.Resource(self.world, self.capacity)

    @property
    def is_crowded(self) -> bool:
        return self.places.count >= self.capacity

    def serve(self, seconds: float, crowded_seconds: float | None = None) -> Steps:
        """Waits for a place and takes it for so long."""
        if not seconds:
            return
        with self.places.request() as place:
            yield place
            taken = crowded_seconds if crowded_seconds is not None and self.is_crowded else seconds
            yield self.world.timeout(taken)
            self.busy_seconds += taken


class _Trainer:
    """A host with GPUs: what they wait for, what is asked of the workers, and what is on its way."""

    def __init__(self, run: Run) -> None:
        world, fleet = run.world, run.fleet
        self.run = run
        self.wanted = simpy.Container(world)
        self.broker, self.nic = _Server(world, 1), _Server(world, 1)
        self.arrived = [simpy.Container(world) for _ in range(fleet.gpus)]
        self.next_gpu = 0
        for gpu in range(fleet.gpus):
            world.process(self.train(gpu))

    def train(self, gpu: int) -> Steps:
        """Two batches are asked for ahead, and at least two samples for each worker."""
        run, fleet = self.run, self.run.fleet
        ahead = max(2 * fleet.batch_size, 2 * math.ceil(fleet.workers / fleet.gpus))
        run.asked += ahead
        yield self.wanted.put(ahead)
        while True:
            began = run.world.now
            yield self.arrived[gpu].get(fleet.batch_size)
            run.waited += run.world.now - began
            run.taken += fleet.batch_size
            run.asked += fleet.batch_size
            yield self.wanted.put(fleet.batch_size)
            yield run.world.timeout(fleet.step_seconds)

    def deliver(self, host: _Server) -> Steps:
        """A sample that is made goes to the GPUs in turn."""
        run = self.run
        yield from self.nic.serve(run.costs.sample_bytes / run.fleet.nic_bytes_per_second)
        yield from run.overhead(host, self.broker, run.costs.broker_seconds)
        if run.fleet.one_host:
            yield from host.serve(run.costs.client_seconds)
        run.arrived += 1
        gpu, self.next_gpu = self.next_gpu, (self.next_gpu + 1) % run.fleet.gpus
        yield self.arrived[gpu].put(1)


class Run:
    """One simulation.

    Args:
        fleet, costs: what there is, and what a sample costs.
        seed: of deaths.
    """

    def __init__(self, fleet: Fleet, costs: Costs, seed: int = 0) -> None:
        self.fleet, self.costs, self.random = fleet, costs, Random(seed)
        self.world = simpy.Environment()
        self.storage = _Server(self.world, 1)
        self.asked = self.arrived = self.taken = self.deaths = 0
        self.waited = 0.0
        self.trainers = [_Trainer(self) for _ in range(fleet.trainers)]
        workers = fleet.trainers * fleet.workers
        self.hosts = [_Server(self.world, fleet.cores) for _ in range(math.ceil(workers / fleet.workers_per_host))]
        slow = round(fleet.slow_share * len(self.hosts))
        for number in range(workers):
            host = number // fleet.workers_per_host
            factor = fleet.slow_factor if host < slow else 1.0
            self.world.process(self.work(self.hosts[host], self.trainers[number % fleet.trainers], factor))

    def overhead(self, host: _Server, broker: _Server, seconds: float) -> Steps:
        """A broker's work: in its one thread, which needs a core of the host where all share one."""
        if self.fleet.one_host and seconds:
            with broker.places.request() as place:
                yield place
                yield from host.serve(seconds)
                broker.busy_seconds += seconds
        else:
            yield from broker.serve(seconds)

    def work(self, host: _Server, trainer: _Trainer, factor: float) -> Steps:
        """A worker's life, and its next ones."""
        costs, fleet = self.costs, self.fleet
        while True:
            yield trainer.wanted.get(1)
            yield from self.storage.serve(costs.video_bytes / fleet.storage_bytes_per_second)
            if self.random.random() < -math.expm1(-costs.worker_seconds * factor / fleet.mean_life_seconds):
                self.deaths += 1
                yield self.world.timeout(fleet.notice_seconds)
                yield trainer.wanted.put(1)
                yield self.world.timeout(max(0.0, fleet.restart_seconds - fleet.notice_seconds))
                continue
            yield from host.serve(costs.worker_seconds * factor, costs.crowded_seconds * factor)
            self.world.process(trainer.deliver(host))

    def outcome(self, seconds: float, warm_up_seconds: float) -> Outcome:
        """Runs the warm-up, then measures for so many simulated seconds."""
        self.world.run(warm_up_seconds)
        servers = {
            "cores": self.hosts,
            "broker": [trainer.broker for trainer in self.trainers],
            "nic": [trainer.nic for trainer in self.trainers],
            "storage": [self.storage],
        }
        before = {name: sum(each.busy_seconds for each in found) for name, found in servers.items()}
        taken, waited = self.taken, self.waited
        self.world.run(warm_up_seconds + seconds)
        places = {name: sum(each.capacity for each in found) for name, found in servers.items()}
        busy = {
            name: (sum(each.busy_seconds for each in found) - before[name]) / (places[name] * seconds)
            for name, found in servers.items()
        }
        gpus = self.fleet.trainers * self.fleet.gpus
        waiting = (self.waited - waited) / (gpus * seconds)
        return Outcome(
            self.taken - taken, seconds, waiting, busy, self.deaths, self.asked, self.arrived, self.asked - self.arrived
        )
