"""Write recordings of cameras outside the training's family, with true pictures, and say which network ships.

    python -m bench recordings --out DIR --video osp_diabolo_240fps.mp4
    v2v-eval --data DIR --window-seconds 0.01 --weights FILE --metrics correlation,lpips_squeeze --lpips squeeze ...
    python -m bench recordings --out DIR --video osp_diabolo_240fps.mp4 --photographs HELD_OUT_DIR \\
        --weights shipped=trainer/shipped/firenet.pt --ema-weights mine=runs/firenet-cpu/last.pt \\
        --normalized-weights published=firenet.pth --lpips squeeze BACKBONE HEADS

Each scene of ``tests/oracles/rendered.py``, at the given speeds, and the liveliest part of each film of high frame rate
is seen by a camera of its own, event by event with exact times: thresholds from 0.15 to 0.4 that differ by pixel, a
low-pass, a refractory period, noise events. No sample of the stream is made this way. A picture every 20 ms is the
truth; the first 100 ms, in which a network has seen little, have none. The scene of a photograph that `firenet-cpu`
trains on is left out.

With networks, it applies the rule of the model card (``bench/accuracy/rule.py``) to those of `--weights` and
`--ema-weights`, on windows of a quarter of an event a pixel and on samples of `--photographs`. Those of
`--normalized-weights` take interpolated voxel grids; they are shown beside and are no candidates.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy import learn, rule
from bench.accuracy.physics import liveliest
from bench.frame import Column, Record, Report, add_whole, progress
from tests.oracles.decoded import decode_luma
from tests.oracles.dense import dense_events
from tests.oracles.rendered import GAMMA, NAMES, Reals, rendered_scene
from trainer.evaluation.metrics import make_metrics
from trainer.run.data import LISTS
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_recordings.items import EventChunk, Picture
from v2v_recordings.layout_writer import RecordingWriter
from v2v_server.video.probe import probe

SECONDS, RENDERED_HZ, PICTURE_EVERY_SECONDS, FIRST_SECONDS = 0.6, 800.0, 0.02, 0.1
SPEEDS_PX_PER_SECOND = (60.0, 250.0)
DARK, MISMATCH_SIGMA, REFRACTORY_SECONDS = 0.02, 0.08, 5e-4
_COLUMNS: tuple[Column, ...] = (
    ("recording", "recording", "{}", 1),
    ("events_per_pixel_second", "events a pixel and second", "{:.1f}", 1),
    ("threshold_pos", "c+", "{:.2f}", 1),
    ("threshold_neg", "c-", "{:.2f}", 1),
    ("corner_hz", "low-pass, Hz", "{:.0f}", 1),
)
_JUDGED: tuple[Column, ...] = (
    ("network", "network", "{}", 1),
    ("data", "data", "{}", 1),
    ("windows", "windows", "{:.0f}", 1),
    ("lpips", "LPIPS", "{:.3f}", 1),
    ("correlation", "correlation", "{:.3f}", 1),
    ("mse", "squared error", "{:.4f}", 1),
    ("grey_mse", "of a constant grey", "{:.4f}", 1),
)


def seen(light: Reals, hz: float, random: np.random.Generator) -> tuple[EventChunk, dict[str, float]]:
    """Return the events of a camera that is drawn, and what was drawn.

    Args:
        light: [n, height, width], 0 .. 1, gamma-coded, at ``hz`` a second; log intensity is linear in between.
    """
    positive, negative = random.uniform(0.15, 0.4, 2)
    corner = float(np.exp(random.uniform(np.log(60), np.log(300))))
    levels = np.log(DARK + light.reshape(len(light), -1) ** GAMMA)
    for now in range(1, len(levels)):
        levels[now] = levels[now - 1] + (levels[now] - levels[now - 1]) * -np.expm1(-2 * np.pi * corner / hz)
    pixels = levels.shape[1]
    levels /= np.clip(random.normal(1, MISMATCH_SIGMA, pixels), 0.5, 2)
    start = random.uniform(-negative, positive, pixels)
    events = dense_events(levels, np.arange(len(levels)) / hz, start, positive, negative)
    kept = np.ones(len(events.pixel), bool)
    kept[1:] = (np.diff(events.seconds) >= REFRACTORY_SECONDS) | (np.diff(events.pixel) != 0)
    seconds = (len(levels) - 1) / hz
    noise = random.poisson(random.uniform(0, 5) * seconds * pixels)
    pixel = np.concatenate([events.pixel[kept], random.integers(pixels, size=noise)])
    moments = np.concatenate([events.seconds[kept], random.uniform(0, seconds, noise)])
    sign = np.concatenate([events.polarity[kept] > 0, random.random(noise) < 0.5])
    order = np.argsort(moments, kind="stable")
    row, column = np.divmod(pixel[order], light.shape[2])
    chunk = EventChunk(np.rint(moments[order] * 1e9).astype(np.int64), column, row, sign[order])
    return chunk, {
        "threshold_pos": positive, "threshold_neg": negative, "corner_hz": corner,
        "events_per_pixel_second": len(chunk) / pixels / seconds,
    }  # fmt: skip


def scenes(side: int, films: list[Path]) -> Iterator[tuple[str, Reals, float]]:
    """Yield name, light and rate of every scene."""
    for name in NAMES:
        for speed in SPEEDS_PX_PER_SECOND:
            scene = rendered_scene(name, side, side, speed)
            light = [scene.light(step / RENDERED_HZ) for step in range(int(SECONDS * RENDERED_HZ) + 1)]
            yield f"{name}_{speed:g}", np.stack(light), RENDERED_HZ
    for path in films:
        facts = probe(path)
        frames = decode_luma(path, facts.index, 0, int(SECONDS * facts.frames_per_second) + 1).frames
        yield path.stem, liveliest(frames, side) / 255.0, facts.frames_per_second


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the recordings")
    parser.add_argument("--video", action="append", default=[], type=Path, metavar="FILE", help="film of high rate")
    add_whole(parser, "--side", 128, "side of the pictures, px", least=32)
    add_whole(parser, "--seed", 0, "seed of the cameras", least=0)
    learn.add_networks(parser)


def judged(asked: argparse.Namespace) -> Report:
    """Judge networks on the recordings and on worlds; return their figures, and what the rule says.

    Raises:
        UsageError: a file of weights is missing or wrong, or ``--photographs`` or ``--lpips`` is.
    """
    if asked.photographs is None or asked.lpips is None:
        raise UsageError("the rule needs --photographs DIR and --lpips NET BACKBONE HEADS beside the networks")
    networks = learn.networks(asked)
    candidates = {entry.partition("=")[0] for entry in [*asked.weights, *asked.ema_weights]}
    lpips = f"lpips_{asked.lpips[0]}"
    metrics = make_metrics([lpips, "correlation", "mse"], {asked.lpips[0]: tuple(asked.lpips[1:])})
    (worlds,) = learn.held_out(asked.photographs, "photographs", learn.PHOTOGRAPHS, asked.samples).values()
    records: list[Record] = []
    by_grids: list[Record] = []
    means: dict[str, dict[str, float]] = {}
    for name, network in networks.items():
        progress(f"judging {name}")
        recorded, parts = rule.on_recordings(
            asked.out, network, metrics, asked.side**2 // 4, published=name not in candidates
        )
        kinds = {"recordings": recorded, "worlds": rule.on_worlds(worlds, network, metrics)}
        means[name] = rule.mean_of(list(kinds.values()), lpips)
        shown = {kind: rule.mean_of([figures], lpips) for kind, figures in kinds.items()} | {"mean": means[name]}
        records += [{"network": name, "data": kind, **figures} for kind, figures in shown.items()]
        by_grids += [{"network": name, "data": part, **rule.mean_of([each], lpips)} for part, each in parts.items()]
    verdict = rule.apply({name: means[name] for name in networks if name in candidates})
    lines = [f"{name} is out: {why}" for name, why in verdict.out.items()]
    tables = [(records, _JUDGED), (by_grids, _JUDGED)]
    return Report([*records, *by_grids], tables, [f"ships: {verdict.ships or 'none, all are out'}", *lines])


def measure(asked: argparse.Namespace) -> Report:
    """Write the recordings; return one record for each, and what :func:`judged` returns."""
    records: list[dict[str, Any]] = []
    rows = csv.DictReader((LISTS / "firenet-cpu.csv").read_text().splitlines())
    trained_on = {Path(row["file"]).stem for row in rows if row["set"] == "training"}
    for number, (name, light, hz) in enumerate(scenes(asked.side, asked.video)):
        if name.partition("_")[0] in trained_on:
            continue
        events, drawn = seen(light, hz, np.random.default_rng((asked.seed, number)))
        with RecordingWriter(asked.out / f"{name}.h5", source=name) as writer:
            writer.add(events)
            for moment in np.arange(FIRST_SECONDS, (len(light) - 1) / hz, PICTURE_EVERY_SECONDS):
                step = round(moment * hz)
                writer.add(Picture(round(step / hz * 1e9), np.rint(255 * light[step]).astype(np.uint8)))
        records.append({"recording": name, **drawn})
        progress(f"{asked.out / name}.h5")
    written = Report(records, [(records, _COLUMNS)])
    if not (asked.weights or asked.ema_weights or asked.normalized_weights):
        return written
    found = judged(asked)
    return Report([*records, *found.records], [*written.tables, *found.tables], found.lines)
