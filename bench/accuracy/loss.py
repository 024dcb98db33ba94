"""Check the predicted loss between frames against rendered scenes of many kinds.

    python -m bench loss --json loss.json

Each kind (``tests/oracles/kinds.py``) is rendered at a high rate for its true events, and seen as 8-bit frames at 30 a
second, c = 0.2. "lost" is the share of the true events that the frames miss, without and with ``substep_px: 1``; less
than 0 where they make more. "low" to "high" is the interval that ``v2v_server/motion/prediction.py`` states from the
frames, "likely" its estimate; "split" is the error of both polarities apart. The weights of the prediction come from
the kinds that calibrate: those of the estimate by least squares, printed here, and those of the ends from the 4 % and
96 % quantiles, made wider where a kind that was left out of the calibration fell outside.

Bar: on the kinds that are held out, 90 % of the scenes lie in their intervals, without and with sub-steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from bench.accuracy.substeps import compared
from bench.frame import Column, Record, Report, beyond, progress
from tests.oracles.kinds import CALIBRATION, FRAMES_PER_SECOND, HELD_OUT, STEPS, scenes_of
from v2v_protocol.command import Parser
from v2v_server.motion.prediction import Features, predict

LEAST_HELD = 0.9
SETTINGS = ("linear", "divided")
_ROUNDED = 0.005
_ROBUST_POINTS = 0.05
_COLUMNS: tuple[Column, ...] = (
    ("kind", "kind", "{}", 1),
    ("scene", "picture", "{}", 1),
    ("px_per_frame", "px a frame", "{:g}", 1),
    *((f"{key}_{name}", f"{key}{title}", "{:.0f}", 100)
      for name, title in zip(SETTINGS, ("", ", sub-steps"), strict=True)
      for key in ("lost", "likely", "low", "high", "split")),
)  # fmt: skip


def scenes(group: str, kind: str) -> Iterator[dict[str, Any]]:
    """Yield one record for each scene of a kind."""
    edges = np.arange(STEPS + 1) / FRAMES_PER_SECOND
    for seen in scenes_of(kind):
        wrong, found = compared(seen.frames, edges, edges, seen.true), predict(seen.frames)
        record: dict[str, Any] = {"measure": "scene", "group": group, "kind": kind, "scene": seen.name}
        record |= {"px_per_frame": seen.px_per_frame, "kept_linear": found.linear / max(found.divided, 1.0)}
        for name in SETTINGS:
            loss = found.loss(divided=name == "divided")
            record |= {f"lost_{name}": -wrong[f"count_{name}"], f"split_{name}": wrong[f"split_{name}"]}
            record |= {f"{end}_{name}": value for end, value in loss._asdict().items()}
        yield record | {f"feature_{name}": value for name, value in found.features._asdict().items()}


def is_inside(record: Record, name: str) -> bool:
    """Return whether a loss lies in its interval; making more events than the truth counts as losing none."""
    lost = max(float(record[f"lost_{name}"]), 0.0)
    return bool(record[f"low_{name}"] - _ROUNDED <= lost <= record[f"high_{name}"] + _ROUNDED)


def summary(group: str, records: Sequence[Record]) -> dict[str, Any]:
    """Return how far the estimates are off, and how often the intervals hold."""
    found: dict[str, Any] = {"measure": "group", "group": group, "scenes": len(records)}
    for name in SETTINGS:
        off = np.array([record[f"likely_{name}"] - record[f"lost_{name}"] for record in records])
        widths = [record[f"high_{name}"] - record[f"low_{name}"] for record in records]
        found |= {
            f"rms_{name}": float(np.sqrt(np.mean(off**2))), f"most_{name}": float(np.abs(off).max()),
            f"inside_{name}": float(np.mean([is_inside(record, name) for record in records])),
            f"width_{name}": float(np.median(widths)),
        }  # fmt: skip
    return found


def weights(records: Sequence[Record]) -> str:
    """Return the weights of the estimate that fit these scenes best."""
    features = np.array([[record[f"feature_{name}"] for name in Features._fields] for record in records])
    kept = np.array([[record["kept_linear"], 1.0] for record in records])
    lost = np.array([[record[f"lost_{name}"] for name in SETTINGS] for record in records])

    def off(tried: Any) -> Any:
        return (1.0 - kept * np.exp(-features @ tried)[:, None] - lost).ravel()

    fitted = least_squares(off, np.zeros(features.shape[1]), loss="soft_l1", f_scale=_ROBUST_POINTS).x
    pairs = zip(Features._fields, fitted, strict=True)
    return f"weights of the estimate: {', '.join(f'{name} {value:.2f}' for name, value in pairs)}"


def add_flags(parser: Parser) -> None:
    """Add the bench's flags: none."""


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records: list[dict[str, Any]] = []
    for group, kinds in (("calibration", CALIBRATION), ("held out", HELD_OUT)):
        for kind in kinds:
            progress(f"{group}: {kind}")
            records += scenes(group, kind)
    groups = [summary(group, [each for each in records if each["group"] == group])
              for group in ("calibration", "held out")]  # fmt: skip
    columns: list[Column] = [("group", "points", "{}", 1), ("scenes", "scenes", "{}", 1)]
    columns += [(f"{key}_{name}", f"{key}{', sub-steps' if name == 'divided' else ''}", "{:.0f}", 100)
                for name in SETTINGS for key in ("rms", "most", "inside", "width")]  # fmt: skip
    lines = [weights([each for each in records if each["group"] == "calibration"])]
    missed = beyond("held-out kinds", groups[1], least={f"inside_{name}": LEAST_HELD for name in SETTINGS})
    return Report([*records, *groups], [(records, _COLUMNS), (groups, columns)], lines, missed)
