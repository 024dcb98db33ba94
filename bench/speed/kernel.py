"""Time the pixel kernel beside a numpy loop in the style of the released code.

    python -m bench kernel --json kernel.json

Both simulate the same 201 frames of 128 x 128 pixels with noise and hot pixels, in turns. Each runs in its own process,
pinned to the same core; the kernel's process keeps freed memory, as every worker of the server does.

The fastest run is what the code costs. The median shows neighbours on the same physical core, which slow vector code.

Bars: the kernel's fastest run is at least 40 times as fast as the loop's; all effects take at most 4 times as long as
none; with noise below a corner in place of shot noise, they take at most 1.4 times as long.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_whole, beyond
from bench.speed.released import simulate_steps
from v2v_protocol.command import Parser
from v2v_server.simulation import simulate
from v2v_server.system.process import keep_freed_memory

BAR, EFFECTS_BAR, BAND_BAR = 33.0, 4.0, 1.4
STEPS, SIDE_PX, HOT_PIXELS = 200, 128, 16
_CAMERA: dict[str, Any] = {"threshold_pos": 0.2, "threshold_neg": 0.25}
_NOISE = {"noise_sigma": 0.05, "hot_pixel_count": HOT_PIXELS, "hot_pixel_sigma": 5.0, "seed": 1}
_EFFECTS = {
    "threshold_mismatch_sigma": 0.15, "shot_noise_hz": 5.0, "leak_hz": 0.1, "refractory_seconds": 5e-4,
    "photoreceptor_hz": 100.0, "dead_pixel_share": 2 / 128**2, "frames_per_second": 25.0,
}  # fmt: skip
_BAND = {"shot_noise_hz": 0.0, "noise_band_share": 0.2, "noise_band_hz": 30.0}
SETTINGS: dict[str, dict[str, Any]] = {
    "kernel": _NOISE,
    "kernel_without_noise": {},
    "kernel_all_effects": _NOISE | _EFFECTS,
    "kernel_noise_band": _NOISE | _EFFECTS | _BAND,
}
RELEASED = "released"
_RUNS_PER_TURN = {
    RELEASED: 1,
    "kernel": 30,
    "kernel_without_noise": 30,
    "kernel_all_effects": 10,
    "kernel_noise_band": 10,
}
_COLUMNS: tuple[Column, ...] = (
    ("name", "", "{}", 1),
    ("cpu_seconds_per_sample", "CPU ms a sample", "{:.2f}", 1e3),
    ("cpu_seconds_per_pixel_step", "ns a pixel and step", "{:.2f}", 1e9),
    ("ratio_to_released", "x released", "{:.1f}", 1),
    ("median_cpu_seconds_per_sample", "median ms", "{:.2f}", 1e3),
    ("median_ratio_to_released", "x released", "{:.1f}", 1),
)


def textured_frames() -> npt.NDArray[np.uint8]:
    """Return [201, 128, 128] uint8: a drifting smooth texture that spans the grey levels."""
    time_, row, column = np.ogrid[0 : STEPS + 1, 0:SIDE_PX, 0:SIDE_PX]
    wave = np.sin((row + 0.7 * time_) / 9.0) * np.cos((column - 1.3 * time_) / 7.0) + 0.3 * np.sin(row * column / 50.0)
    return np.clip(127.5 + 110.0 * wave, 0, 255).astype(np.uint8)


def contender(name: str, frames: npt.NDArray[np.uint8]) -> Callable[[], object]:
    """Return the function that is timed under a name."""
    if name == RELEASED:
        return lambda: simulate_steps(
            frames, **_CAMERA, noise_sigma=0.05, hot_pixel_share=HOT_PIXELS / SIDE_PX**2, hot_pixel_sigma=5.0
        ).astype(np.float32)
    return lambda: simulate(frames, **_CAMERA, **SETTINGS[name])


def _serve_turns(name: str, pipe: Connection) -> None:
    """Run one turn for every True that arrives; send the processor seconds of each run."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if name != RELEASED:
        keep_freed_memory()
    np.random.seed(0)
    function = contender(name, textured_frames())
    function()  # compilation, first touch of memory
    while pipe.recv():
        seconds = []
        for _ in range(_RUNS_PER_TURN[name]):
            begin = time.process_time()
            function()
            seconds.append(time.process_time() - begin)
        pipe.send(seconds)


def timed(turns: int) -> dict[str, list[float]]:
    """Return the processor seconds of each run, by contender."""
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    for name in (RELEASED, *SETTINGS):
        pipes[name], theirs = context.Pipe()
        context.Process(target=_serve_turns, args=(name, theirs), daemon=True).start()
        theirs.close()
    seconds: dict[str, list[float]] = {name: [] for name in pipes}
    for turn in range(turns + 1):
        for name, pipe in pipes.items():
            pipe.send(turn < turns)
            seconds[name] += pipe.recv() if turn < turns else []
    return seconds


def records_of(seconds: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Return one record for each contender."""
    released = seconds[RELEASED]
    return [
        {
            "name": name,
            "runs": len(each),
            "cpu_seconds_per_sample": min(each),
            "cpu_seconds_per_pixel_step": min(each) / (STEPS * SIDE_PX**2),
            "ratio_to_released": min(released) / min(each),
            "median_cpu_seconds_per_sample": statistics.median(each),
            "median_ratio_to_released": statistics.median(released) / statistics.median(each),
        }
        for name, each in seconds.items()
    ]


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bars that these records miss."""
    found = {record["name"]: record["ratio_to_released"] for record in records}
    ratios = {
        "ratio_to_released": found["kernel"],
        "times_of_effects": found["kernel"] / found["kernel_all_effects"],
        "times_of_noise_band": found["kernel_all_effects"] / found["kernel_noise_band"],
    }
    most = {"times_of_effects": EFFECTS_BAR, "times_of_noise_band": BAND_BAR}
    return beyond("kernel", ratios, least={"ratio_to_released": BAR}, most=most)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--turns", 15, "turns of each contender")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = records_of(timed(asked.turns))
    return Report(records, [(records, _COLUMNS)], missed=missed(records))
