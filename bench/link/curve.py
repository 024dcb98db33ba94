"""What keys cost on loopback: batches a second with CURVE against without, in turns.

    v2v-bench curve --videos CLIPS --fast-videos PREPARED --turns 5 --seconds 5

Two servers stand ready, one with keys, and a consumer takes from one and from the other. "null workers" make nothing:
all that is measured is moving, by shared memory as on one host, or by messages, where every byte is encrypted; only the
latter also stands for what goes over a network, where samples are compressed first. Then the product at work: exact
mode on the source, and the fastest preset on a prepared folder.

    kept    batches/s with keys over those without, within a turn; median of the turns

Bars: null workers with shared memory, and the fastest preset, keep 0.85; exact mode 0.97: turns differ by so much.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from bench.records import Column, at_least, parser_of, recipe_of, run, say_missed, server_flags, show, write
from bench.speed.null_service import null_service
from bench.usage import Roles, consume, roles_of
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.spec import SpeedPreset
from v2v_server.keys.folder import KeyFolder

BARS = {"null workers, shared memory": 0.85, "fast": 0.85, "exact": 0.97}
_COLUMNS: tuple[Column, ...] = (
    ("name", "", "{}", 1.0),
    ("batches_per_second", "batches/s", "{:.2f}", 1.0),
    ("keyed_batches_per_second", "with keys", "{:.2f}", 1.0),
    ("kept", "kept", "{:.3f}", 1.0),
    ("kept_lowest", "lowest", "{:.3f}", 1.0),
    ("kept_highest", "highest", "{:.3f}", 1.0),
    ("cpu_ratio", "CPU a batch x", "{:.3f}", 1.0),
)
_Served = tuple[str, Roles]
_Serve = Callable[[Sequence[str]], AbstractContextManager[_Served]]
"""Flags -> a running server's address, and its processes."""


def compare(
    name: str, serve: _Serve, keys: tuple[Path, Path], asked: argparse.Namespace, options: dict[str, Any]
) -> dict[str, Any]:
    """The record of one way to serve.

    Args:
        name: of it.
        serve: starts a server.
        keys: folder of the server's, and file of the consumer's.
        asked: the command line.
        options: more of the dataset's.
    """
    turns = []
    with ExitStack() as stack:
        plain = stack.enter_context(serve([]))
        keyed = stack.enter_context(serve(["--keys", str(keys[0])]))
        for turn in range(asked.turns):
            found = {}
            for (address, roles), key in ((plain, ""), (keyed, str(keys[1])))[:: -1 if turn % 2 else 1]:
                dataset = V2VStreamDataset(address, asked.batch_size, rank=0, world_size=1, keys=key, **options)
                found[bool(key)] = consume(dataset, roles, seconds=asked.seconds, warmup_batches=4)
            turns.append((found[False], found[True]))
    kept = [mine.batches_per_second / base.batches_per_second for base, mine in turns]
    cpu = [mine.cpu_seconds_per_batch() / base.cpu_seconds_per_batch() for base, mine in turns]
    return {
        "name": name,
        "batches_per_second": statistics.median(base.batches_per_second for base, _ in turns),
        "keyed_batches_per_second": statistics.median(mine.batches_per_second for _, mine in turns),
        "kept": statistics.median(kept),
        "kept_lowest": min(kept),
        "kept_highest": max(kept),
        "cpu_ratio": statistics.median(cpu),
    }


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, batch_size=1, turns=1)
    recipe, flags = recipe_of(asked.changes), server_flags(asked.changes)

    @contextmanager
    def null(more: Sequence[str]) -> Iterator[_Served]:
        with null_service(recipe, workers=2, flags=[*flags, *more]) as service:
            yield service.server.address, service.roles

    def at_work(videos: Path, rows: str) -> _Serve:
        @contextmanager
        def serve(more: Sequence[str]) -> Iterator[_Served]:
            with LocalServer(videos, workers=2, flags=["--rows", rows, *flags, *more]) as server:
                yield server.address, roles_of(server)

        return serve

    rows: list[tuple[str, _Serve, dict[str, Any]]] = [
        ("null workers, shared memory", null, {}),
        ("null workers, messages", null, {"shared_memory": False}),
    ]
    works: list[tuple[SpeedPreset, Path | None, str]] = [
        ("exact", asked.videos, asked.rows),
        ("fast", asked.fast_videos, asked.fast_rows),
    ]
    rows += [
        (preset, at_work(videos, which), {"preset": preset}) for preset, videos, which in works if videos is not None
    ]
    with tempfile.TemporaryDirectory(prefix="v2v-curve-") as name:
        folder, file = Path(name, "keys"), Path(name, "consumer.key")
        KeyFolder(folder).init()
        KeyFolder(folder).new("bench", "consumer", file)
        records = [compare(name, serve, (folder, file), asked, options) for name, serve, options in rows]
    show(records, _COLUMNS)
    write(records, asked.json)
    missed = [
        f"{record['name']}: {record['kept']:.3f} kept with keys, at least {BARS[record['name']]} was asked"
        for record in records
        if record["kept"] < BARS.get(record["name"], 0.0)
    ]
    return say_missed(missed)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "curve", seconds=5.0, what="each stretch")
    parser.add_argument("--videos", type=Path, metavar="DIR", help="clips of exact mode")
    parser.add_argument("--rows", default="full")
    parser.add_argument("--fast-videos", type=Path, metavar="DIR", help="clips of the fastest preset (prepared)")
    parser.add_argument("--fast-rows", default="full")
    parser.add_argument("--batch-size", type=int, default=12)
    parser.add_argument("--turns", type=int, default=5)
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
