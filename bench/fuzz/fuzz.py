"""Throws frames that no peer of ours would send at the decoder and at a live server.

    python -m bench.fuzz.fuzz --frames 1000000
    python -m bench.fuzz.fuzz --frames 1000 --live 100000 --videos DIR

The decoder has to answer every frame with a message or a ProtocolError, at once and without taking memory. A live
server is attacked on both of its ports (:mod:`bench.fuzz.peers`) while a healthy consumer streams from it: it must
go on answering, take no memory that stays, and the healthy consumer must get its exact bytes, which are compared with
the schedule and with samples made elsewhere, as in :mod:`bench.chaos.chaos`.

Everything follows from the seed; a failure prints the number of its frame and the bytes.

Exit status: 0 nothing gave way, 1 something did, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import math
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from bench.chaos.chaos import checked
from bench.chaos.fleet import Fleet
from bench.fuzz.frames import MESSAGE_TYPES, FrameFuzzer
from bench.fuzz.peers import Attack
from bench.speed.memory import MIB, rss_mib
from v2v_protocol.errors import ProtocolError, UsageError, V2VError
from v2v_protocol.records import write_json
from v2v_protocol.wire import decode, decode_sample

MOST_GROWTH_MIB = 16.0
"""More resident memory than before, after everything, is a leak."""
MOST_PEAK_GROWTH_MIB = 64.0
"""More than that at any moment of the decoder's run: something was allocated because a frame said so."""
MOST_DECODE_SECONDS = 1.0
"""Processor time: a busy host is not the decoder's fault."""
_SHOWN_BYTES = 400
_UNDER_ATTACK_SECONDS = 60.0
"""For how long at most the attack goes on until the healthy consumer has had a batch."""
_TRIM_SECONDS = 0.5
_SETTLE_SECONDS = 30.0
_SETTLED_LOOKS = 4


def fuzz_decoder(frames: int, seed: int) -> dict[str, Any]:
    """Decodes that many frames; a flat record.

    The first tenth warms up: memory is compared with what it was after that.
    """
    fuzzer = FrameFuzzer(random.Random(seed))
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    longest = 0.0
    before = peak_before = 0.0
    began = time.perf_counter()
    for number in range(frames):
        if number == frames // 10:
            before, peak_before = psutil.Process().memory_info().rss / MIB, _peak_mib()
        whole_sample = number % 5 == 4
        header: Any
        payload: list[bytes] = []
        if whole_sample:
            header, payload = fuzzer.sample()
        else:
            header = fuzzer.header()
        asked = time.thread_time()
        try:
            if whole_sample:
                decode_sample(header, payload)
                outcomes["samples"] += 1
            else:
                message = decode(header)
                outcomes["messages"] += 1
                if type(message) not in MESSAGE_TYPES:
                    failures.append(f"frame {number}: decode returned {type(message).__name__}")
        except ProtocolError as error:
            outcomes["refused"] += 1
            if len(str(error)) > 5000:
                failures.append(f"frame {number}: an error of {len(str(error))} characters")
        except Exception as error:  # noqa: BLE001 - that there is no other kind is what is tested
            shown = repr(header) if whole_sample else header[:_SHOWN_BYTES].hex()
            failures.append(f"frame {number}: {type(error).__name__}: {error}; {shown[: 2 * _SHOWN_BYTES]}")
        longest = max(longest, time.thread_time() - asked)
    return {
        "target": "decoder",
        "frames": frames,
        "seed": seed,
        "messages": outcomes["messages"],
        "samples": outcomes["samples"],
        "refused": outcomes["refused"],
        "failures": failures,
        "seconds": time.perf_counter() - began,
        "longest_cpu_seconds": longest,
        "rss_before_mib": before,
        "rss_after_mib": psutil.Process().memory_info().rss / MIB,
        "peak_growth_mib": _peak_mib() - peak_before,
    }


def _peak_mib() -> float:
    """The most memory this process ever had."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MIB if sys.platform == "darwin" else 1024.0)


def fuzz_live(
    videos: Path, messages: int, seed: int, folder: Path, remakes: int = 100, keyed: bool = False
) -> dict[str, Any]:
    """Attacks a server while a healthy consumer streams from it; a flat record.

    Args:
        videos: the corpus.
        messages: to send in all.
        seed: of the messages.
        folder: a new one, for logs.
        remakes: samples of the healthy consumer that are made again.
        keyed: the server takes nobody without a key, and the attackers have one for each port.

    Raises:
        UsageError: the server does not come up.
    """
    server = "bench.fuzz.trimming_server"
    fleet = Fleet(folder, videos, 1, 1, lease_deadline_seconds=10.0, server_module=server, keyed=keyed)
    try:
        fleet.start()
        pid = fleet.server.pid or 0
        # What the first messages need (arenas of Python and of threads, caches) is not what a leak would be.
        with Attack(*fleet.addresses, random.Random(seed), fleet.keys) as warm_up:
            warm_up.send(max(1, messages // 10))
        before = _settled_mib(pid)
        with Attack(*fleet.addresses, random.Random(f"{seed} after warm-up"), fleet.keys) as attack:
            began, committed = time.monotonic(), fleet.committed()[0]
            attack.send(messages - messages // 10)
            # Few messages are out before the healthy consumer has had time for one batch: then some more.
            while fleet.committed()[0] == committed and time.monotonic() < began + _UNDER_ATTACK_SECONDS:
                attack.send(50)
            longest = attack.longest_seconds
            seconds = time.monotonic() - began
            under_attack = fleet.committed()[0] - committed
            alive = attack.answered()
        after = _settled_mib(pid, before + MOST_GROWTH_MIB)
        _await_batches(fleet, fleet.committed()[0] + 3)
        fleet.look(time.monotonic())
        failures = [f"{failure.name} ended: {failure.text}" for failure in fleet.failures]
        left = fleet.stop()
    finally:
        fleet.kill()
    verdict = checked(fleet, remakes, seed)
    wrong = ("lost", "duplicated", "mismatched", "out_of_order", "broken_lives", "substituted")
    failures += [f"the healthy consumer: {key} {verdict[key]}" for key in wrong if verdict[key]]
    failures += [f"left over: {text}" for text in left]
    failures += [] if alive else ["the server stopped answering"]
    sent = (warm_up.sent + attack.sent).total()
    if sent < messages:
        failures.append(f"{sent} of {messages} frames were sent: then no new connection was answered for a while")
    return {
        "target": "server",
        "frames": sent,
        "seed": seed,
        "healthy_samples": verdict["samples"],
        "healthy_batches_under_attack": under_attack,
        "failures": failures,
        "seconds": seconds,
        "longest_seconds": longest,
        "rss_before_mib": before,
        "rss_after_mib": after,
        **{f"sent_{form.replace('-', '_')}": count for form, count in sorted((warm_up.sent + attack.sent).items())},
    }


def _settled_mib(pid: int, limit_mib: float = math.inf) -> float:
    """Resident memory of a trimming server (0 when it is gone) that has read what was on its way to it: once that is
    within the limit and has not fallen for a while, or when the time is up."""
    deadline = time.monotonic() + _SETTLE_SECONDS
    lowest, unchanged = math.inf, 0
    while True:
        with suppress(psutil.NoSuchProcess):
            psutil.Process(pid).send_signal(signal.SIGUSR2)
            time.sleep(_TRIM_SECONDS)
        held = rss_mib(pid) or 0.0
        unchanged = 0 if held < lowest - 1.0 else unchanged + 1
        lowest = min(lowest, held)
        if time.monotonic() > deadline or (held <= limit_mib and unchanged >= _SETTLED_LOOKS):
            return held


def _await_batches(fleet: Fleet, count: int, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while fleet.committed()[0] < count:
        fleet.look(time.monotonic())
        if len(fleet.failures) > 3 or time.monotonic() > deadline:
            raise UsageError(f"the healthy consumer gets no batches: {fleet.crowd[0].last_lines()}")
        time.sleep(0.1)


def gave_way(record: dict[str, Any]) -> list[str]:
    """What a record says went wrong, in words; nothing if all is well."""
    wrong = list(record["failures"])
    growth = record["rss_after_mib"] - record["rss_before_mib"]
    if growth > MOST_GROWTH_MIB:
        wrong.append(f"resident memory grew by {growth:.1f} MiB; the limit is {MOST_GROWTH_MIB:g}")
    if record.get("peak_growth_mib", 0.0) > MOST_PEAK_GROWTH_MIB:
        wrong.append(f"memory peaked {record['peak_growth_mib']:.1f} MiB higher; the limit is {MOST_PEAK_GROWTH_MIB:g}")
    if record["target"] == "decoder" and record["longest_cpu_seconds"] > MOST_DECODE_SECONDS:
        taken = record["longest_cpu_seconds"]
        wrong.append(f"one frame took {taken:.2f} s of processor time; the limit is {MOST_DECODE_SECONDS:g}")
    return wrong


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="python -m bench.fuzz.fuzz",
        description=first,
        epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=100_000, help="through the decoder (default 100000)")
    parser.add_argument("--live", type=int, default=0, help="through a live server (default 0)")
    parser.add_argument("--videos", type=Path, metavar="DIR", help="with --live: corpus of the server")
    parser.add_argument("--keys", action="store_true", help="with --live: by attackers who have keys; all is encrypted")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="with --live: keep its logs in this new folder")
    asked = parser.parse_args(arguments)
    try:
        if asked.frames < 0 or asked.live < 0 or (asked.live and asked.videos is None):
            raise UsageError("--frames and --live are 0 or more; --live needs --videos DIR")
        records = [fuzz_decoder(asked.frames, asked.seed)] if asked.frames else []
        if asked.live:
            folder = Path(tempfile.mkdtemp(prefix="v2v-fuzz-")) if asked.keep is None else asked.keep
            try:
                records.append(fuzz_live(asked.videos, asked.live, asked.seed, folder, keyed=asked.keys))
            finally:
                if asked.keep is None:
                    shutil.rmtree(folder)
        if asked.json is not None:
            write_json(asked.json, records)
    except (V2VError, OSError) as error:
        print(f"fuzz: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    wrong = []
    for record in records:
        for key, value in record.items():
            if key != "failures":
                print(f"{key:32} {value:.4g}" if isinstance(value, float) else f"{key:32} {value}")
        wrong += gave_way(record)
        print()
    for text in wrong[:20]:
        print(f"gave way: {text}")
    return 1 if wrong else 0


if __name__ == "__main__":
    # An exception, so that everything that was started is ended.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(main())
