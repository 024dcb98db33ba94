"""Send hostile frames to the decoder and to a live server.

    python -m bench fuzz --frames 1000000
    python -m bench fuzz --frames 1000 --live 100000 --videos DIR

The decoder must answer every frame with a message or a ProtocolError, in less than 1 s, with at most 64 MiB more
memory at its peak. A live server is attacked on both ports (:mod:`tests.oracles.hostile_peers`) while a healthy
consumer streams: the server must keep answering, and the consumer must receive its exact bytes, as in
`python -m bench chaos`. After either, at most 16 MiB more memory may remain.

All frames follow from the seed; a failure shows the number of its frame and the bytes.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.chaos.chaos import checked
from bench.chaos.fleet import Fleet
from bench.chaos.trimming_server import MODULE, settled_mib
from bench.frame import Report, add_whole, key_values
from tests.oracles.hostile_frames import MOST_GROWTH_MIB, failed, fuzz_decoder
from tests.oracles.hostile_peers import Attack
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError

_UNDER_ATTACK_SECONDS = 60.0  # Longest extension of the attack until the healthy consumer has a batch
_LAST_BATCHES_SECONDS = 120.0


def fuzz_live(
    videos: Path, messages: int, seed: int, folder: Path, remakes: int = 100, keyed: bool = False
) -> dict[str, Any]:
    """Attack a server while a healthy consumer streams; return a flat record.

    Args:
        videos: the corpus.
        messages: to send.
        seed: of the messages.
        folder: a new one, for logs.
        remakes: samples of the healthy consumer to make again and compare.
        keyed: whether the server requires keys; the attackers have one for each port.

    Raises:
        UsageError: the server does not start.
    """
    fleet = Fleet(folder, videos, 1, 1, lease_deadline_seconds=10.0, server_module=MODULE, keyed=keyed)
    try:
        fleet.start()
        pid = fleet.server.pid or 0
        # The memory of the first messages (arenas, caches) is not a leak.
        keys = {fleet.address: fleet.key("consumer"), fleet.worker_address: fleet.key("worker")} if keyed else {}
        with Attack(fleet.address, fleet.worker_address, random.Random(seed), keys) as warm_up:
            warm_up.send(max(1, messages // 10))
        before = settled_mib(pid)
        with Attack(fleet.address, fleet.worker_address, random.Random(f"{seed} after warm-up"), keys) as attack:
            began, committed = time.monotonic(), fleet.committed()[0]
            attack.send(messages - messages // 10)
            # A few messages are sent before the healthy consumer has a batch: send some more.
            while fleet.committed()[0] == committed and time.monotonic() < began + _UNDER_ATTACK_SECONDS:
                attack.send(50)
            seconds = time.monotonic() - began
            under_attack = fleet.committed()[0] - committed
            alive = attack.answered()
        after = settled_mib(pid, before + MOST_GROWTH_MIB)
        wanted = fleet.committed()[0] + 3
        fleet.wait_for(lambda: fleet.committed()[0] >= wanted, time.monotonic() + _LAST_BATCHES_SECONDS)
        left = fleet.stop()
    finally:
        fleet.kill()
    verdict = checked(fleet, remakes, seed)
    wrong = ("lost", "duplicated", "mismatched", "out_of_order", "broken_lives", "substituted")
    failures = [f"the healthy consumer: {key} {verdict[key]}" for key in wrong if verdict[key]]
    failures += [f"left over: {text}" for text in left]
    failures += [] if alive else ["the server stopped answering"]
    sent = warm_up.sent + attack.sent
    if sent.total() < messages:
        failures.append(f"{sent.total()} of {messages} frames were sent: no further connection was answered")
    return {
        "target": "server",
        "frames": sent.total(),
        "seed": seed,
        "healthy_samples": verdict["samples"],
        "healthy_batches_under_attack": under_attack,
        "failures": failures,
        "seconds": seconds,
        "longest_seconds": attack.longest_seconds,
        "rss_before_mib": before,
        "rss_after_mib": after,
        **{f"sent_{kind}": count for kind, count in sorted(sent.items())},
    }


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--frames", 100_000, "frames for the decoder", least=0)
    add_whole(parser, "--live", 0, "frames for a live server", least=0)
    parser.add_argument("--videos", type=Path, metavar="DIR", help="with --live: corpus of the server")
    parser.add_argument("--keys", action="store_true", help="with --live: require keys, which the attackers have")
    add_whole(parser, "--seed", 0, "of the frames", least=0)


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: --live without --videos.
    """
    if asked.live and asked.videos is None:
        raise UsageError("--live needs a corpus: give --videos DIR")
    records = [fuzz_decoder(asked.frames, asked.seed)] if asked.frames else []
    if asked.live:
        with tempfile.TemporaryDirectory(prefix="v2v-fuzz-") as name:
            records.append(fuzz_live(asked.videos, asked.live, asked.seed, Path(name, "run"), keyed=asked.keys))
    tables = [key_values({key: value for key, value in record.items() if key != "failures"}) for record in records]
    return Report(records, tables, missed=[text for record in records for text in failed(record)[:20]])
