"""How the stream grows with its workers, and where one broker ends.

    python -m bench.speed.scaling --videos CLIPS --workers 1,2,8 --repeat 3 --json scaling.json --plot scaling.png

workers   the stream end to end with each number of server workers, in turn, several times over; medians. Client and
          broker share the cores with the workers.
broker    null workers, which cost nothing: what one broker and one client carry; the broker's processor time for a
          batch, and the most memory it ever had beside its credit window.
stalled   a consumer that asks for all its credit and reads nothing: the whole window stays in the broker.

Last it says how many real workers would keep one broker's core busy. That is arithmetic on the processor times measured
here, not a measurement.

Exit status: 1 where a bar is missed: two workers less than 1.75 times one; eight slower than two (where there are no
more than four cores), both within a turn; a broker below 1 GB/s; a broker above 150 MB plus its credit window.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq

from bench import plots
from bench.records import counts, parser_of, recipe_of, run, say_missed, server_flags, show, write
from bench.speed.null_service import null_service
from bench.usage import consume, peak_rss_bytes, roles_of
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import ServerLost, UsageError
from v2v_protocol.messages import Hello, Want, Welcome
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import DEFAULT_ARRAYS, array_layout, layout_bytes
from v2v_protocol.wire import decode, encode
from v2v_server.system.process import usable_cores

LEAST_GAIN_OF_TWO = 1.75
LEAST_BYTES_PER_SECOND = 1e9
MOST_BROKER_BYTES = 150_000_000
"""Beside the credit window."""
_FEW_CORES = 4
_COLUMNS = (
    ("measure", "", "{}", 1),
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s", "{:.2f}", 1),
    ("ratio_to_one_worker", "x one", "{:.2f}", 1),
    ("ratio_to_two_workers", "x two", "{:.2f}", 1),
    ("bytes_per_second", "GB/s", "{:.3f}", 1e-9),
    ("workers_cpu_seconds_per_batch", "workers ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("client_cpu_seconds_per_batch", "client ms", "{:.1f}", 1e3),
    ("broker_peak_rss_bytes", "broker MB", "{:.0f}", 1e-6),
    ("credit_window_bytes", "window MB", "{:.0f}", 1e-6),
    ("worker_peak_rss_bytes", "worker MB", "{:.0f}", 1e-6),
)


def end_to_end(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """One record a number of workers: medians over the turns, of ratios within a turn too; and every turn's speed."""
    turns: list[dict[int, dict[str, Any]]] = []
    for turn in range(asked.repeat):
        # Every other turn goes backwards, so that a drift of the machine favours nobody.
        order = asked.workers if turn % 2 == 0 else tuple(reversed(asked.workers))
        turns.append({workers: _one_run(asked, workers) for workers in order})
        for name, few in (("ratio_to_one_worker", 1), ("ratio_to_two_workers", 2)):
            held_against = turns[-1][few]["batches_per_second"] if few in turns[-1] else None
            for run_ in turns[-1].values():
                run_[name] = None if held_against is None else run_["batches_per_second"] / held_against
    return [
        {"measure": "workers", "workers": workers, "turns": asked.repeat}
        | _medians([turn[workers] for turn in turns])
        | {"batches_per_second_by_turn": [turn[workers]["batches_per_second"] for turn in turns]}
        for workers in asked.workers
    ]


def _one_run(asked: argparse.Namespace, workers: int) -> dict[str, Any]:
    flags = ["--rows", asked.rows, *server_flags(asked.changes)]
    with LocalServer(asked.videos, workers=workers, flags=flags) as server:
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, rank=0, world_size=1)
        roles = roles_of(server)
        # Every worker has finished a sample by then, on average.
        warmup = 1 + workers // asked.batch_size
        done = consume(dataset, roles, seconds=asked.seconds, warmup_batches=warmup)
        return {
            "batches_per_second": done.batches_per_second,
            "bytes_per_second": done.nbytes / done.seconds,
            **{f"{role}_cpu_seconds_per_batch": done.cpu_seconds_per_batch(role) for role in roles},
            "broker_peak_rss_bytes": peak_rss_bytes(server.pid),
            "worker_peak_rss_bytes": max(map(peak_rss_bytes, roles["workers"])),
        }


def _medians(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    first = records[0]
    return {key: None if first[key] is None else statistics.median(record[key] for record in records) for key in first}


def broker_alone(asked: argparse.Namespace, recipe: Recipe, workers: int) -> dict[str, Any]:
    """The record of one number of null workers."""
    with null_service(recipe, workers=workers, flags=server_flags(asked.changes)) as service:
        dataset = V2VStreamDataset(service.server.address, batch_size=asked.batch_size, rank=0, world_size=1)
        done = consume(dataset, service.roles, seconds=asked.seconds, warmup_batches=2)
        return {
            "measure": "broker",
            "workers": workers,
            "batches_per_second": done.batches_per_second,
            "bytes_per_second": done.nbytes / done.seconds,
            **{f"{role}_cpu_seconds_per_batch": done.cpu_seconds_per_batch(role) for role in done.cpu_seconds},
            "broker_peak_rss_bytes": peak_rss_bytes(service.server.pid),
            "credit_window_bytes": dataset_credit(service.server.address, asked.batch_size) * sample_bytes(recipe),
        }


def sample_bytes(recipe: Recipe) -> int:
    """Of the default arrays."""
    return layout_bytes(array_layout(recipe, "int8", DEFAULT_ARRAYS))


def dataset_credit(address: str, batch_size: int) -> int:
    """Samples that the server lets a consumer ask for."""
    with _Deaf(address, batch_size) as consumer:
        return consumer.credit


class _Deaf:
    """A consumer that can stop reading: its socket takes one message and leaves the others to the server."""

    def __init__(self, address: str, batch_size: int) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.RCVHWM, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(address)
        self._socket.send_multipart(encode(Hello({}, DEFAULT_ARRAYS, batch_size, 0)))
        if not self._socket.poll(10_000):
            raise ServerLost(f"{address} does not answer")
        welcome = decode(self._socket.recv_multipart()[0])
        if not isinstance(welcome, Welcome):
            raise UsageError(f"{address} refuses: {welcome}")
        self.credit = welcome.credit

    def __enter__(self) -> _Deaf:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=0)

    def ask(self) -> None:
        """Spends the whole credit."""
        self._socket.send_multipart(encode(Want(0, tuple(range(self.credit)))))


def stalled(asked: argparse.Namespace, recipe: Recipe, workers: int) -> dict[str, Any]:
    """The record of a consumer that reads nothing: waits until the broker's memory has not grown for a second."""
    with null_service(recipe, workers=workers, flags=server_flags(asked.changes)) as service:
        with _Deaf(service.server.address, asked.batch_size) as consumer:
            consumer.ask()
            most, since = 0, time.monotonic()
            while time.monotonic() - since < 1.0:
                peak = peak_rss_bytes(service.server.pid)
                if peak > most:
                    most, since = peak, time.monotonic()
                time.sleep(0.05)
            window = consumer.credit * sample_bytes(recipe)
        return {
            "measure": "stalled",
            "workers": workers,
            "broker_peak_rss_bytes": most,
            "credit_window_bytes": window,
        }


def missed_bars(records: Sequence[dict[str, Any]], cores: int) -> list[str]:
    """The bars that these records do not keep."""
    missed = []
    by_workers = {item["workers"]: item for item in records if item["measure"] == "workers"}
    gain = by_workers[2]["ratio_to_one_worker"] if 2 in by_workers else None
    if gain is not None and gain < LEAST_GAIN_OF_TWO:
        missed.append(f"2 workers are {gain:.2f} times as fast as 1; the bar is {LEAST_GAIN_OF_TWO}")
    # Within a turn: the machine changes from one turn to the next by more than what is asked here.
    crowded = by_workers[8]["ratio_to_two_workers"] if 8 in by_workers and cores <= _FEW_CORES else None
    if crowded is not None and crowded < 1:
        missed.append(f"8 workers are {crowded:.3f} times as fast as 2; the bar is 1")
    best = max((item["bytes_per_second"] for item in records if item["measure"] == "broker"), default=None)
    if best is not None and best < LEAST_BYTES_PER_SECOND:
        missed.append(f"the broker carries {best / 1e9:.2f} GB/s; the bar is {LEAST_BYTES_PER_SECOND / 1e9:g}")
    for item in records:
        limit = MOST_BROKER_BYTES + item.get("credit_window_bytes", 0)
        if item["broker_peak_rss_bytes"] > limit:
            missed.append(
                f"{item['measure']}, {item['workers']} workers: the broker had "
                f"{item['broker_peak_rss_bytes'] / 1e6:.0f} MB; the bar is {limit / 1e6:.0f}"
            )
    return missed


def extrapolated(records: Sequence[dict[str, Any]]) -> list[str]:
    """What the processor times say about more workers than were run."""
    real = [item for item in records if item["measure"] == "workers"]
    null = [item for item in records if item["measure"] == "broker"]
    if not real or not null:
        return []
    made = min(item["workers_cpu_seconds_per_batch"] for item in real)
    if not made:
        return ["nothing is extrapolated: a run was too short for its processor time to be told"]
    lines = []
    for role in ("broker", "client"):
        carried = null[-1][f"{role}_cpu_seconds_per_batch"]
        lines.append(
            f"extrapolated, not measured: a {role} spends {carried * 1e3:.1f} ms of processor time on a batch, a worker"
            f" {made * 1e3:.0f} ms, so {made / carried:.0f} workers of one core each keep one core of it busy, at "
            f"{1 / carried:.0f} batches/s; 1000 workers need {1000 * carried / made:.1f} such cores"
        )
    return lines


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or a process that died.
    """
    if asked.repeat < 1:
        raise UsageError(f"--repeat {asked.repeat}: give 1 or more")
    recipe = recipe_of(asked.changes)
    records = end_to_end(asked)
    records += [broker_alone(asked, recipe, workers) for workers in asked.null_workers]
    records.append(stalled(asked, recipe, max(asked.null_workers)))
    records = [record | {"batch_size": asked.batch_size, "cores": usable_cores()} for record in records]
    show(records, _COLUMNS)
    print(*extrapolated(records), sep="\n")
    write(records, asked.json)
    if asked.plot is not None:
        plot(asked.plot, records)
    return say_missed(missed_bars(records, usable_cores()))


def plot(file: Path, records: Sequence[dict[str, Any]]) -> None:
    """Speed over workers; what the broker carries and what memory it takes over null workers."""
    by = {
        measure: {item["workers"]: item for item in records if item["measure"] == measure}
        for measure in ("workers", "broker")
    }
    with plots.panels(file, 3, title="More workers: speed, traffic and memory") as (speed, carried, memory):
        plots.line(speed, {n: item["batches_per_second"] for n, item in by["workers"].items()}, "measured")
        first = min(by["workers"])
        alone = by["workers"][first]["batches_per_second"] / first
        plots.line(speed, {n: alone * n for n in by["workers"]}, "proportional", style="--")
        plots.whole_number_axis(speed, list(by["workers"]), f"server workers ({records[0]['cores']} cores)")
        speed.set_ylabel("batches/s")
        null = by["broker"]
        plots.line(carried, {n: item["bytes_per_second"] / 1e9 for n, item in null.items()}, "by the clock")
        plots.line(
            carried,
            {
                n: item["bytes_per_second"] / item["batches_per_second"] / item["broker_cpu_seconds_per_batch"] / 1e9
                for n, item in null.items()
            },
            "a second of the broker's CPU",
        )
        carried.axhline(LEAST_BYTES_PER_SECOND / 1e9, color="grey", linewidth=0.8, label="bar")
        plots.whole_number_axis(carried, list(null), "null workers")
        carried.set_ylabel("GB/s through the broker")
        plots.line(memory, {n: item["broker_peak_rss_bytes"] / 1e6 for n, item in null.items()}, "broker, peak")
        bound = {n: (MOST_BROKER_BYTES + item["credit_window_bytes"]) / 1e6 for n, item in null.items()}
        plots.line(memory, bound, "150 MB + credit window", style="--")
        last = records[-1]
        plots.line(memory, {last["workers"]: last["broker_peak_rss_bytes"] / 1e6}, "consumer stalled", style="s")
        plots.whole_number_axis(memory, list(null), "null workers")
        memory.set_ylabel("MB resident")
        for axes in (speed, carried, memory):
            axes.set_ylim(bottom=0)
            axes.legend()


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "scaling", seconds=10.0, what="each run")
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument("--workers", type=counts, default=(1, 2, 8), metavar="N,N", help="server workers (1,2,8)")
    parser.add_argument("--null-workers", type=counts, default=(1, 2, 8, 64), metavar="N,N", help="default 1,2,8,64")
    parser.add_argument("--repeat", type=int, default=3, help="turns of the workers part (default 3)")
    parser.add_argument("--batch-size", type=int, default=12)
    return run(parser, work, arguments)


if __name__ == "__main__":
    sys.exit(main())
