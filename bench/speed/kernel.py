"""The pixel kernel against the released style's numpy loop: one 201-frame 128x128 sample, one core.

    python -m bench.speed.kernel --json kernel.json

Both simulate the same frames with noise and hot pixels, in turns of equal length; processor time. Each has a process of
its own, pinned to the same core: the loop a plain one, as its users run it; the kernel one that keeps freed memory
(``v2v_server.system.process.keep_freed_memory``), as every worker of the server does.

Two figures of each: the fastest run, which is what the code costs, and the median, in which a neighbour on the same
physical core shows (it slows vector code by a third and the loop hardly). The exit status is 1 when the kernel's
fastest run is not at least 40 times as fast as the loop's, or with all effects of ``docs/effects.md`` more than 4 times
as slow as without.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.speed.released import simulate_steps
from v2v_protocol.records import write_json
from v2v_server.simulation import simulate
from v2v_server.system.process import keep_freed_memory

BAR = 40.0
EFFECTS_BAR = 4.0
STEPS, SIDE_PX = 200, 128
HOT_PIXELS = 16
EFFECTS: dict[str, Any] = {
    "threshold_mismatch_sigma": 0.15, "shot_noise_hz": 5.0, "leak_hz": 0.1, "refractory_seconds": 5e-4,
    "photoreceptor_hz": 100.0, "dead_pixel_share": 2 / 128**2, "frames_per_second": 25.0,
}  # fmt: skip
RUNS_PER_TURN = {"released": 1, "kernel": 30, "kernel_without_noise": 30, "kernel_all_effects": 10}
CONTENDERS = tuple(RUNS_PER_TURN)


def textured_frames() -> npt.NDArray[np.uint8]:
    """[201, 128, 128] uint8: a drifting smooth texture that spans the grey levels."""
    time_, row, column = np.ogrid[0 : STEPS + 1, 0:SIDE_PX, 0:SIDE_PX]
    wave = np.sin((row + 0.7 * time_) / 9.0) * np.cos((column - 1.3 * time_) / 7.0) + 0.3 * np.sin(row * column / 50.0)
    return np.clip(127.5 + 110.0 * wave, 0, 255).astype(np.uint8)


def contender(name: str, frames: npt.NDArray[np.uint8]) -> Callable[[], object]:
    """What is timed under that name."""
    camera: dict[str, Any] = {"threshold_pos": 0.2, "threshold_neg": 0.25}
    if name == "released":
        return lambda: simulate_steps(
            frames, **camera, noise_sigma=0.05, hot_pixel_share=HOT_PIXELS / SIDE_PX**2, hot_pixel_sigma=5.0
        ).astype(np.float32)
    if name in ("kernel", "kernel_all_effects"):
        effects = EFFECTS if name == "kernel_all_effects" else {}
        return lambda: simulate(
            frames, **camera, noise_sigma=0.05, hot_pixel_count=HOT_PIXELS, hot_pixel_sigma=5.0, seed=1, **effects
        )
    return lambda: simulate(frames, **camera)


def serve_turns(name: str, runs_per_turn: int, pipe: Connection) -> None:
    """The process of one contender: for every True it receives, one turn; sends the processor seconds of each run."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if name != "released":
        keep_freed_memory()
    np.random.seed(0)
    function = contender(name, textured_frames())
    function()  # compilation, first touch
    while pipe.recv():
        seconds = []
        for _ in range(runs_per_turn):
            begin = time.process_time()
            function()
            seconds.append(time.process_time() - begin)
        pipe.send(seconds)


def measure(turns: int) -> list[dict[str, Any]]:
    """Flat records, one per contender: processor seconds of a sample, and how they compare to the released style."""
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    for name in CONTENDERS:
        pipes[name], theirs = context.Pipe()
        context.Process(target=serve_turns, args=(name, RUNS_PER_TURN[name], theirs), daemon=True).start()
        theirs.close()
    seconds: dict[str, list[float]] = {name: [] for name in CONTENDERS}
    for _ in range(turns):
        for name, pipe in pipes.items():
            pipe.send(True)
            seconds[name] += pipe.recv()
    for pipe in pipes.values():
        pipe.send(False)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    return [
        {
            "name": name,
            "runs": len(seconds[name]),
            "cpu_seconds_per_sample": min(seconds[name]),
            "cpu_seconds_per_pixel_step": min(seconds[name]) / (STEPS * SIDE_PX**2),
            "ratio_to_released": min(seconds["released"]) / min(seconds[name]),
            "median_cpu_seconds_per_sample": median,
            "median_ratio_to_released": medians["released"] / median,
        }
        for name, median in medians.items()
    ]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.turns < 1:
        parser.error(f"--turns {arguments.turns}: give 1 or more")
    records = measure(arguments.turns)
    for record in records:
        print(
            f"{record['name']:22s}{record['cpu_seconds_per_sample'] * 1e3:9.2f} ms"
            f"{record['cpu_seconds_per_pixel_step'] * 1e9:8.2f} ns a pixel and step{record['ratio_to_released']:8.1f} x"
            f"      median {record['median_cpu_seconds_per_sample'] * 1e3:7.2f} ms"
            f"{record['median_ratio_to_released']:8.1f} x"
        )
    if arguments.json is not None:
        write_json(arguments.json, records)
    by_name = {record["name"]: record for record in records}
    ratio = by_name["kernel"]["ratio_to_released"]
    slower = by_name["kernel_all_effects"]["cpu_seconds_per_sample"] / by_name["kernel"]["cpu_seconds_per_sample"]
    if ratio < BAR:
        print(f"bar missed: the kernel is {ratio:.1f} times as fast; the bar is {BAR:.0f}", file=sys.stderr)
    if slower > EFFECTS_BAR:
        print(f"bar missed: all effects take {slower:.2f} times as long; the bar is {EFFECTS_BAR:.0f}", file=sys.stderr)
    return 1 if ratio < BAR or slower > EFFECTS_BAR else 0


if __name__ == "__main__":
    sys.exit(main())
