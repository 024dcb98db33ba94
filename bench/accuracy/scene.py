"""What scene "auto" saves, and the error it adds, apart for decoding, simulation and flow.

    v2v-bench scene --videos DIR --json scene.json --plot scene.png

The sequences of the videos are made with scene "off" and with "auto" and the default flow, of the same cameras. CPU
times are those of one thread; the two take turns. Real videos have no true flow: endpoint errors are taken against
dense inverse search at half the size (dis-fast-1), on three voxels of each clip. Clips rendered for the purpose (a
still, a dark, a fast one, one with a cut) are shown beside them and count in no mean.

Bars: flow takes at least 30 % less CPU over all videos, the median endpoint error rises by at most 0.05 px, a still
clip costs no flow, and no sequence holds the cut.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from bench.accuracy.known_motion import Grey, photograph
from bench.plots import panels
from bench.records import Column, Record, recipe_of, say_missed, show, write
from v2v_protocol.errors import UsageError, V2VError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.broker.terms import lease_for
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
from v2v_server.catalogue.look import look
from v2v_server.flow import FlowSettings, flow_for, view_part
from v2v_server.flow.methods import one_thread
from v2v_server.prepare.encode import encode_luma
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.variants import warm_up
from v2v_server.simulation.view import apply_view
from v2v_server.store.encoding import Encoding
from v2v_server.video.decode import stream_luma
from v2v_server.worker.produce import Decoded, decode_for
from v2v_server.worker.scene_choice import TOLERANCE_PX

LEAST_SAVED = 0.3
"""Bar: share of the CPU of flow that is saved over all videos."""
_REFERENCE = "dis-fast-1"
_COMPARED_VOXELS = 3
_LOOKED_FRAMES = 64
_HEIGHT_PX, _WIDTH_PX = 240, 320
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Clip:
    """One sequence, measured; times in CPU seconds of a sample, "off" first.

    Attributes:
        video, start_frame, reason: which, and what was decided.
        decode, flow: with scene "off" and "auto".
        simulation: of both alike.
        errors: per scene, [n] endpoint errors against the reference, px.
        methods: of each voxel under "auto".
    """

    video: str
    start_frame: int
    reason: str
    decode: tuple[float, float]
    simulation: float
    flow: tuple[float, float]
    errors: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
    methods: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """As a flat record."""
        off, auto = (float(np.median(errors)) for errors in self.errors)
        return {
            "measure": "clip",
            "video": self.video,
            "start_frame": self.start_frame,
            "decision": self.reason.partition(";")[0],
            "reason": self.reason,
            "decode_off_cpu_seconds": self.decode[0],
            "decode_auto_cpu_seconds": self.decode[1],
            "simulation_cpu_seconds": self.simulation,
            "flow_off_cpu_seconds": self.flow[0],
            "flow_auto_cpu_seconds": self.flow[1],
            "flow_saved_share": 1 - self.flow[1] / self.flow[0],
            "error_off_median_px": off,
            "error_auto_median_px": auto,
            "added_error_median_px": auto - off,
        }


def rendered(folder: Path, frames: int) -> None:
    """A still, a dark and a fast clip, and one whose second half is another scene, twice ``frames`` long.

    Raises:
        VideoError: no encoder.
    """
    window = _pan(photograph("camera"), frames, 6)
    clips = {
        "still": np.repeat(window[:1], frames, axis=0),
        "dark": _pan(photograph("camera"), frames, 1) // 20,
        "fast": window,
        "cut": np.concatenate([_pan(photograph("camera"), frames, 1), _pan(photograph("chelsea"), frames, 1)]),
    }
    for name, luma in clips.items():
        encode_luma(
            folder / f"{name}.mp4", luma, Encoding("h264", quality=8, gop=250), height=_HEIGHT_PX, width=_WIDTH_PX,
            pts=range(len(luma)), time_base=Fraction(1, 25),
        )  # fmt: skip


def _pan(photo: Grey, frames: int, step_px: int) -> Grey:
    """[frames, 240, 320] a window that glides to the right and wraps around."""
    columns = (np.arange(frames)[:, None] * step_px + np.arange(_WIDTH_PX)) % photo.shape[1]
    return np.ascontiguousarray(photo[:_HEIGHT_PX].transpose(1, 0)[columns].transpose(0, 2, 1))


def measure(catalogue: Catalogue, off: StreamSpec, auto: StreamSpec, most: int) -> Iterator[Clip]:
    """The sequences of a corpus under scene "auto", at most ``most`` of each video; what fails is left out."""
    table = SequenceTable(catalogue.videos, catalogue.rows, auto)
    taken: dict[str, int] = {}
    for rank in range(table.count):
        sequence = table[rank]
        taken[sequence.video.id] = taken.get(sequence.video.id, 0) + 1
        if taken[sequence.video.id] > most:
            continue
        leases = [
            lease_for(
                Request(b"", 0, rank), sequence=sequence, catalogue=catalogue, spec=spec, seed=0,
                arrays=("voxels", "flow"),
            )
            for spec in (off, auto)
        ]  # fmt: skip
        try:
            yield _measured(leases, catalogue.folder)
        except VideoError as error:
            print(f"left out: {error}", file=sys.stderr)


def _measured(leases: Sequence[Lease], root: Path) -> Clip:
    decode_for(leases[0], leases[0].indices, root)  # the file is in memory now, for both alike
    plain, plain_seconds = _timed(partial(_decoded, leases[0], root))
    chosen, chosen_seconds = _timed(partial(_decoded, leases[1], root))
    before, flow_off = _timed(partial(_flow, plain))
    after, flow_auto = _timed(partial(_flow, chosen))
    _, simulation = _timed(partial(_simulated, plain))
    voxels = np.linspace(0, len(before) - 1, _COMPARED_VOXELS).round().astype(int)
    truth = _flow(plain, _REFERENCE)[voxels].astype(np.float32)
    errors = [np.linalg.norm(flow[voxels] - truth, axis=1).ravel() for flow in (before, after)]
    flow_plan = chosen.plan.flow_plan
    return Clip(
        leases[1].video, leases[1].start_frame, "" if flow_plan is None else flow_plan.reason,
        (plain_seconds, chosen_seconds), simulation, (flow_off, flow_auto), (errors[0], errors[1]),
        () if flow_plan is None else flow_plan.methods,
    )  # fmt: skip


def _timed(work: Callable[[], _T]) -> tuple[_T, float]:
    started = time.process_time()
    result = work()
    return result, time.process_time() - started


def _decoded(lease: Lease, root: Path) -> Decoded:
    return decode_for(lease, lease.indices, root)[0]


def _flow(decoded: Decoded, method: str | None = None) -> npt.NDArray[np.float16]:
    """[T, 2, H, W] as the worker makes it, or all of it by one method."""
    plan = decoded.plan
    settings = _settings(decoded) if method is None else replace(_settings(decoded), method=method)
    methods = plan.flow_plan.methods if plan.flow_plan is not None and method is None else ()
    return flow_for(decoded.clip.frames, plan.params, plan.spec.recipe, settings, plan=methods).flow


def _simulated(decoded: Decoded) -> object:
    params, spec = decoded.plan.params, decoded.plan.spec
    view = view_part(decoded.clip.frames, params, spec.recipe, _settings(decoded).margin_px)
    return simulate_clip(apply_view(view, params, spec.recipe), params, spec.recipe, spec.voxel_dtype, None)


def _settings(decoded: Decoded) -> FlowSettings:
    if decoded.plan.flow is None:
        raise UsageError("the lease asks for no flow")
    return decoded.plan.flow


def looking(catalogue: Catalogue) -> Record:
    """CPU of the look at all videos, of decoding and of the statistics apart."""
    decoding, statistics, frames = 0.0, 0.0, 0
    for video in catalogue.videos:
        top, bottom = catalogue.rows.bounds(video.height_px)
        window = (top, 0, bottom - top, video.width_px)
        source = stream_luma(catalogue.path(video.id), catalogue.frame_index(video.id), 0, video.frames, window)
        started = time.process_time()
        try:
            pictures = list(islice(source, _LOOKED_FRAMES))
        except VideoError:
            continue
        decoding += time.process_time() - started
        frames += len(pictures)
        statistics += _timed(partial(look, pictures))[1]
    return {
        "measure": "look",
        "frames": frames,
        "decode_cpu_seconds_per_frame": decoding / frames,
        "statistics_cpu_seconds_per_frame": statistics / frames,
    }


def totals(clips: Sequence[Clip], plain: SequenceTable, chosen: SequenceTable) -> list[Record]:
    """What each part of a sample costs with scene off and auto, and the error that is added to it."""
    # The median of what clips add says more than a median over pixels of which one clip may have half.
    added = float(np.median([clip.record()["added_error_median_px"] for clip in clips]))
    pooled = [np.concatenate([clip.errors[side] for clip in clips]) for side in (0, 1)]
    rows = {
        "decode": (sum(clip.decode[0] for clip in clips), sum(clip.decode[1] for clip in clips), 0.0),
        "simulation": (sum(clip.simulation for clip in clips),) * 2 + (0.0,),
        "flow": (
            sum(clip.flow[0] for clip in clips),
            sum(clip.flow[1] for clip in clips),
            float(np.median(pooled[1]) - np.median(pooled[0])),
        ),
    }
    records: list[Record] = [
        {
            "measure": "part", "part": part, "samples": len(clips), "off_cpu_seconds_per_sample": off / len(clips),
            "auto_cpu_seconds_per_sample": auto / len(clips), "saved_share": 1 - auto / off,
            "added_error_median_px": px,
        }
        for part, (off, auto, px) in rows.items()
    ]  # fmt: skip
    records.append({
        "measure": "errors", "off_mean_px": float(pooled[0].mean()), "auto_mean_px": float(pooled[1].mean()),
        "off_median_px": float(np.median(pooled[0])), "auto_median_px": float(np.median(pooled[1])),
        "added_median_of_clips_px": added,
        "added_worst_clip_px": max(clip.record()["added_error_median_px"] for clip in clips),
    })  # fmt: skip
    records.append({
        "measure": "sequences", "off": plain.count, "auto": chosen.count, "left_out_or_moved": chosen.spoilt,
    })  # fmt: skip
    return records


def missed(records: Sequence[Record], made: Sequence[Clip], starts: Sequence[int], frames: int) -> list[str]:
    """The bars that were missed.

    Args:
        records: of :func:`totals`.
        made: the rendered clips.
        starts: first frames of the sequences of the rendered clip with a cut, which lies at frame ``frames``.
        frames: of a sequence.
    """
    flow = next(record for record in records if record.get("part") == "flow")
    still = [clip for clip in made if clip.video == "still.mp4"]
    texts = []
    if flow["saved_share"] < LEAST_SAVED:
        texts.append(f"flow takes {flow['saved_share']:.0%} less CPU; the bar is {LEAST_SAVED:.0%}")
    if flow["added_error_median_px"] > TOLERANCE_PX:
        texts.append(f"the median error rises by {flow['added_error_median_px']:.3f} px; the bar is {TOLERANCE_PX} px")
    if not still or any(set(clip.methods) != {"zero"} for clip in still):
        texts.append("the still clip is estimated: " + "; ".join(clip.reason for clip in still))
    if not starts or any(start < frames < start + frames for start in starts):
        texts.append(f"the sequences from {list(starts)} hold the cut at {frames}")
    return texts


_CLIPS: tuple[Column, ...] = (
    ("video", "video", "{}", 1),
    ("start_frame", "from", "{}", 1),
    ("decision", "decision", "{}", 1),
    ("flow_off_cpu_seconds", "flow off ms", "{:.1f}", 1e3),
    ("flow_auto_cpu_seconds", "auto ms", "{:.1f}", 1e3),
    ("flow_saved_share", "saved", "{:.0f} %", 1e2),
    ("error_off_median_px", "error off px", "{:.3f}", 1),
    ("added_error_median_px", "added px", "{:+.3f}", 1),
)
_PARTS: tuple[Column, ...] = (
    ("part", "part", "{}", 1),
    ("off_cpu_seconds_per_sample", "off ms", "{:.2f}", 1e3),
    ("auto_cpu_seconds_per_sample", "auto ms", "{:.2f}", 1e3),
    ("saved_share", "saved", "{:.1f} %", 1e2),
    ("added_error_median_px", "added median error px", "{:+.4f}", 1),
)


def draw(records: Sequence[Record], file: Path) -> None:
    """Saved flow against added error, a dot a clip."""
    clips = [record for record in records if record["measure"] == "clip"]
    with panels(file, 2, title="What choosing by the scene changes") as (left, right):
        kinds = sorted({record["decision"] for record in clips})
        for kind in kinds:
            chosen = [record for record in clips if record["decision"] == kind]
            left.scatter(
                [record["flow_saved_share"] * 100 for record in chosen],
                [record["added_error_median_px"] for record in chosen],
                label=kind,
            )
        left.axhline(TOLERANCE_PX, color="grey", linestyle=":")
        left.set_xlabel("CPU of flow saved, %")
        left.set_ylabel("added median endpoint error, px")
        left.legend()
        parts = [record for record in records if record["measure"] == "part"]
        places = np.arange(len(parts))
        for shift, scene in ((-0.2, "off"), (0.2, "auto")):
            values = [record[f"{scene}_cpu_seconds_per_sample"] * 1e3 for record in parts]
            right.bar(places + shift, values, 0.4, label=f"scene {scene}")
        right.set_xticks(places, [str(record["part"]) for record in parts])
        right.set_ylabel("CPU of a sample, ms")
        right.legend()


def main() -> int:
    """The command line."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="v2v-bench scene", description=first, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--videos", type=Path, required=True, metavar="DIR", help="a folder of real videos")
    parser.add_argument("--sequences", type=int, default=3, metavar="N", help="of each video at most (3)")
    parser.add_argument(
        "--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="change a recipe field"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw them")
    asked = parser.parse_args()
    try:
        return _run(asked)
    except (V2VError, OSError) as error:
        print(f"scene: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _run(asked: argparse.Namespace) -> int:
    # Short clips, so that videos of two seconds take part.
    recipe = recipe_of(["voxels_per_clip=8", *asked.changes])
    off, auto = (StreamSpec(recipe=recipe, scene=scene) for scene in ("off", "auto"))
    warm_up()
    with tempfile.TemporaryDirectory() as folder, one_thread():
        made = Path(folder, "rendered")
        made.mkdir()
        rendered(made, recipe.frames_needed)
        with closing(open_catalogue(asked.videos, cache_dir=folder, scene=True, processes=1)) as catalogue:
            clips = list(measure(catalogue, off, auto, asked.sequences))
            if not clips:
                raise UsageError(f"--videos {asked.videos}: no video gives a sequence of {recipe.frames_needed} frames")
            tables = [SequenceTable(catalogue.videos, catalogue.rows, spec) for spec in (off, auto)]
            records = [*totals(clips, tables[0], tables[1]), looking(catalogue)]
        with closing(open_catalogue(made, cache_dir=folder, scene=True, processes=1)) as catalogue:
            artificial = list(measure(catalogue, off, auto, asked.sequences))
    shown = [clip.record() for clip in clips] + [clip.record() | {"measure": "rendered"} for clip in artificial]
    show(shown, _CLIPS)
    show([record for record in records if record["measure"] == "part"], _PARTS)
    for record in records:
        if record["measure"] != "part":
            print(json.dumps(record))
    write([*records, *shown], asked.json)
    if asked.plot is not None:
        draw([*records, *shown], asked.plot)
    starts = [clip.start_frame for clip in artificial if clip.video == "cut.mp4"]
    return say_missed(missed(records, artificial, starts, recipe.frames_needed))


if __name__ == "__main__":
    sys.exit(main())
