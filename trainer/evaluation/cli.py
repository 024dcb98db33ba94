"""Run `v2v-eval`.

Exit status: 0 all existing recordings were evaluated, 1 some could not be, 2 wrong usage or input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import torch
from rich.console import Console

from trainer.convert.conversion import in_layout
from trainer.evaluation.config import EvaluationConfig, folder_config, read_config, shipped
from trainer.evaluation.evaluate import Advance, Drawing, Run, check_recording, evaluate_sequence, find_recordings
from trainer.evaluation.flow import FlowRun, FlowScore, evaluate_flow, flow_records, flow_table
from trainer.evaluation.metrics import METRICS, make_metrics
from trainer.evaluation.readers import VIDEO_GAMMA
from trainer.evaluation.reconstruct import Stretch
from trainer.evaluation.score import SequenceScore
from trainer.evaluation.tables import records, table, write_frames
from trainer.evaluation.voxelise import Kind, Span, VoxelSettings
from trainer.weights import SHIPPED, load_network
from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.programs import show
from v2v_protocol.progress import Progress
from v2v_protocol.write_aside import JSON, write_json
from v2v_recordings.items import ConvertOptions, Light, SensorSize

OF_PICTURES = (
    "metrics",
    "lpips",
    "stretch",
    "window_seconds",
    "window_events",
    "window_pictures",
    "fps",
    "rows",
    "light",
    "video",
    "per_frame",
)
"""Flags that a flow network has no use for."""
LEAST_WIDTH = 110
"""Width of tables that are not written to a terminal, in characters."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run_command(_parser(), _run, argv)


def _parser() -> Parser:
    parser = Parser(
        "v2v-eval", "[CONFIG] [--weights FILE] --data DIR [flags]",
        "Reconstruct pictures from recordings of event cameras, or estimate their flow, and score the result.",
        [
            "v2v-eval paper-discrete --weights runs/e2vid/last.pt --data recordings/",
            "v2v-eval --data own.h5 --out pictures/ --video",
        ],
        "Exit status: 0 all recordings were evaluated, 1 some could not be and are named, 2 wrong usage or input.",
    )  # fmt: skip
    what, how, out = parser.group("What"), parser.group("How"), parser.group("Output")
    what.add_argument(
        "config", nargs="?", metavar="CONFIG",
        help=f"YAML file, or one of {', '.join(sorted(shipped()))}; default: all recordings of --data",
    )  # fmt: skip
    what.add_argument(
        "--weights", default=str(SHIPPED), metavar="FILE",
        help="weights of the network; code in the file is never executed (default: this project's FireNet, "
        "docs/model-card.md)",
    )  # fmt: skip
    what.add_argument(
        "--data", required=True, metavar="DIR",
        help="with CONFIG: folder with one folder per data set; without: folder of event files, or a single recording "
        "of any form that v2v-convert reads",
    )  # fmt: skip
    what.add_argument("--ema", action="store_true", help="take the averaged weights of a checkpoint of v2v-train")
    how.add_argument(
        "--normalize-voxels", action="store_true", help="normalise every voxel grid, as the published FireNet requires"
    )
    how.add_argument("--voxels", choices=get_args(Kind), help="kind of voxel grids (default: CONFIG's, or discrete)")
    how.add_argument(
        "--span", choices=get_args(Span),
        help="what the bins divide: the time from a window's first to its last event (published, default), or the "
        "whole window",
    )  # fmt: skip
    what.add_argument("--metrics", metavar="A,B", help=f"some of {', '.join(METRICS)} (default: CONFIG's)")
    what.add_argument(
        "--lpips", nargs=3, action="append", default=[], metavar=("NET", "BACKBONE", "HEADS"),
        help="weight files of LPIPS for alex, squeeze or vgg; may be repeated",
    )  # fmt: skip
    how.add_argument(
        "--stretch", choices=get_args(Stretch), default="none",
        help="how to map reconstructions to 0 .. 1 before scoring: from minimum to maximum (min-max), from "
        "the 1st to the 99th percentile (robust), or by histogram equalisation (equalized) (default: none)",
    )  # fmt: skip
    what.add_argument(
        "--cuts", choices=("paper", "none"), default="paper",
        help="time range of each recording to score: that of CONFIG (paper, default), or all of it (none)",
    )  # fmt: skip
    how.add_argument(
        "--as-published", action="store_true",
        help="evaluate as the released code does, including its faults: event_idx as stored, times truncated to us, "
        "EVAID's time ranges one picture later",
    )  # fmt: skip
    windows = how.add_mutually_exclusive_group()
    windows.add_argument(
        "--window-seconds", type=float, metavar="S",
        help="windows of S seconds, instead of from picture to picture; a picture is scored against the window whose "
        "end is nearest, at most half a window away",
    )  # fmt: skip
    windows.add_argument("--window-events", type=int, metavar="N", help="windows of N events, scored the same way")
    windows.add_argument(
        "--window-pictures", type=int, default=1, metavar="N",
        help="windows from each picture to the N-th after it (default 1)",
    )  # fmt: skip
    windows.add_argument(
        "--fps", type=float, metavar="N", help="reconstruct N pictures per second of the recording, without scores"
    )
    how.add_argument("--size", metavar="WxH", help="size of the sensor in px, for recordings without pictures")
    how.add_argument(
        "--light", metavar="CURVE",
        help="light of the pictures: linear (DAVIS), srgb, or the exponent of their light, such as 2.2: score them as "
        "videos code them, with gamma 2.2 (default: score them as stored)",
    )  # fmt: skip
    how.add_argument("--device", metavar="D", help="PyTorch device (default: cuda if available, else cpu)")
    out.add_argument("--out", metavar="DIR", help="folder to write a picture of each sequence to")
    out.add_argument("--rows", type=int, default=6, metavar="N", help="rows of each picture (default 6)")
    out.add_argument("--video", action="store_true", help="also write a video of each sequence to --out")
    parser.add_output("Output", "--json", JSON, "also write the scores as flat records to this file")
    parser.add_output("Output", "--per-frame", (".csv",), "also write the scores of every window to this file")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    data = Path(arguments.data)
    if not data.exists():
        raise UsageError(f"--data {data}: no such folder or file")
    if arguments.config is not None:
        return _evaluate(arguments, data, read_config(arguments.config))
    size = None if arguments.size is None else SensorSize.parse(arguments.size)
    with contextlib.ExitStack() as files:
        with Progress("converting", "%") as progress:
            data = files.enter_context(in_layout(data, ConvertOptions(size=size), progress))
        return _evaluate(arguments, data, folder_config(data))


def _evaluate(arguments: argparse.Namespace, data: Path, config: EvaluationConfig) -> int:
    run, model = _prepare(arguments, config)
    if run.network.task == "flow":
        return _run_flow(arguments, data, config, run, model)
    lights: set[str] = set()
    scores: dict[str, list[SequenceScore]] = {}
    unscored = Unscored()
    found = [(data_set, path) for data_set in config.data_sets for path in find_recordings(data, data_set).values()]
    for data_set, path in found:  # a wrong one is named before the others are evaluated, which may take hours
        with unscored.noting(path):
            lights.add(check_recording(run, path, data_set))
    try:
        with Progress("evaluating", "windows") as progress:
            for data_set, path in found:
                if path in unscored.reasons:
                    continue
                with unscored.noting(path):
                    score = evaluate_sequence(run, path, data_set, _advance(progress))
                    scores.setdefault(data_set.name, []).append(score)
    except KeyboardInterrupt:
        if scores:
            print("interrupted; scores of the completed sequences:", file=sys.stderr)
            _print(config, scores)
        raise
    if not scores:
        unscored.fail()
        wanted = ", ".join(f"{data_set.folder}/*.h5 ({data_set.name})" for data_set in config.data_sets)
        raise UsageError(f"--data {data} holds no sequence of {wanted}; create the files with v2v-convert")
    _print(config, scores)
    if run.metrics:
        show(_of_light(run, lights))
    if arguments.per_frame is not None:
        write_frames(arguments.per_frame, scores)
    if arguments.json is not None:
        settings = {
            "model": model,
            "weights": str(arguments.weights),
            "voxels": run.voxels.kind,
            "span": run.voxels.span,
            "as_published": run.as_published,
            "cuts": arguments.cuts,
            "reconstruction_hz": run.fps,
            "window_pictures": run.window_pictures,
            "window_seconds": run.window_seconds,
            "window_events": run.window_events,
            "stretch": run.stretch,
            "light": "as stored" if run.light is None else run.light.name,
        }
        write_json(arguments.json, records(scores, settings))
    return unscored.status


def _of_light(run: Run, lights: set[str]) -> str:
    """Say in which light pictures are scored: networks trained on videos draw what a video codes."""
    if run.light is not None:
        return f"pictures: taken as {run.light.name}, and scored as videos code them, with gamma {VIDEO_GAMMA}"
    stated = ", ".join(sorted(name or "light not stated" for name in lights))
    return f"pictures: scored as stored ({stated}); --light scores them as videos code them"


def _run_flow(arguments: argparse.Namespace, data: Path, config: EvaluationConfig, run: Run, model: str) -> int:
    parser = _parser()
    given = [name for name in OF_PICTURES if getattr(arguments, name) != parser.get_default(name)]
    if given:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(f"{flags}: for networks that reconstruct pictures, and {model} estimates flow; leave them out")
    flow_run = FlowRun(run.network, run.voxels, run.device, run.as_published, run.drawing.folder, run.size)
    settings = {"model": model, "weights": str(arguments.weights), "as_published": run.as_published}
    written: list[dict[str, object]] = []
    unscored = Unscored()
    console = Console() if Console().is_terminal else Console(width=LEAST_WIDTH)
    for data_set in config.data_sets:
        found = find_recordings(data, data_set)
        with Progress("evaluating", "windows") as progress:
            scores: dict[str, dict[str, FlowScore]] = {}
            for sequence, path in found.items():
                time_range = data_set.time_ranges[sequence] if run.use_time_ranges else None
                with unscored.noting(path):
                    scores[sequence] = evaluate_flow(flow_run, path, time_range, _advance(progress))
        console.print(flow_table(data_set.name, scores, config.paper))
        written += flow_records(data_set.name, scores, settings)
    if not written:
        unscored.fail()
        raise UsageError(f"--data {data} holds no sequence of {', '.join(each.name for each in config.data_sets)}")
    if arguments.json is not None:
        write_json(arguments.json, written)
    return unscored.status


class Unscored:
    """The recordings that cannot be scored; the others are.

    Attributes:
        reasons: why, by file.
    """

    def __init__(self) -> None:
        self.reasons: dict[Path, UsageError] = {}

    @contextlib.contextmanager
    def noting(self, path: Path) -> Iterator[None]:
        """Keep an error of the body as the reason of a recording, and name it on standard error."""
        try:
            yield
        except UsageError as error:
            self.reasons[path] = error
            show(f"v2v-eval: not scored: {' '.join(str(error).split())}", sys.stderr)

    def fail(self) -> None:
        """Fail with the first reason, if there is one: no recording was scored.

        Raises:
            UsageError: that reason.
        """
        for reason in self.reasons.values():
            reason.is_reported = True
            raise reason

    @property
    def status(self) -> int:
        """The exit status of a command that has scored others."""
        return FAILED if self.reasons else 0


def _prepare(arguments: argparse.Namespace, config: EvaluationConfig) -> tuple[Run, str]:
    options: dict[str, Any] = dict(config.model_options)
    if arguments.normalize_voxels:
        options["normalize_voxels"] = True
    network, model = load_network(arguments.weights, name=config.model, options=options, ema=arguments.ema)
    voxels = config.voxels or VoxelSettings(bins=network.bins)
    changed = {"kind": arguments.voxels, "span": arguments.span, "truncate": arguments.as_published or None}
    voxels = dataclasses.replace(voxels, **{name: value for name, value in changed.items() if value is not None})
    lpips_files = {net: (backbone, heads) for net, backbone, heads in arguments.lpips}
    device = _device(arguments.device)
    names: Sequence[str] = config.metrics
    if arguments.metrics is not None:
        names = [name.strip() for name in arguments.metrics.split(",")]
    elif arguments.fps is not None:
        names = ()
    else:
        # Metrics whose weight files are given are computed.
        names = list(dict.fromkeys([*names, *(f"lpips_{net}" for net in lpips_files)]))
    if arguments.fps is not None and names:
        raise UsageError("--fps computes no scores: leave out --metrics")
    if arguments.fps is not None and arguments.out is None:
        raise UsageError(
            "--fps computes no scores: give --out DIR for its pictures, and --video for a film of all of them"
        )
    run = Run(
        network=network,
        voxels=voxels,
        metrics=make_metrics(names, lpips_files, device),
        device=device,
        as_published=arguments.as_published,
        use_time_ranges=arguments.cuts == "paper",
        fps=arguments.fps,
        window_pictures=arguments.window_pictures,
        window_seconds=arguments.window_seconds,
        window_events=arguments.window_events,
        size=_size(arguments.size),
        stretch=arguments.stretch,
        light=None if arguments.light is None else Light.parse(arguments.light),
        drawing=Drawing(None if arguments.out is None else Path(arguments.out), arguments.rows, arguments.video),
    )
    return run, model


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    size = SensorSize.parse(text)
    return size.height, size.width


def _device(wanted: str | None) -> str:
    device = wanted or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError) as error:  # an unknown name, or a device that this host does not have
        reason = str(error).partition("\n")[0]
        raise UsageError(f"--device {device}: PyTorch cannot compute there: {reason}") from error
    return device


def _print(config: EvaluationConfig, scores: dict[str, list[SequenceScore]]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=LEAST_WIDTH)
    for data_set in config.data_sets:
        if data_set.name not in scores:
            console.print(f"{data_set.name}: 0 of {len(data_set.time_ranges)} sequences scored", markup=False)
            continue
        console.print(table(data_set, scores[data_set.name], config.paper))
        for score in scores[data_set.name]:
            if score.repaired_images or score.empty_windows:
                console.print(
                    f"{score.sequence}: {score.repaired_images} time stamps of pictures repaired, "
                    f"{score.empty_windows} windows without events",
                    markup=False,
                )


def _advance(progress: Progress) -> Advance:
    return lambda sequence, done, total: progress(done, total, what=sequence)


if __name__ == "__main__":
    sys.exit(main())
