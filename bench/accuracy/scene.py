"""Measure what scene "auto" saves, and the error that it adds to the flow.

    python -m bench scene --videos DIR --json scene.json

The sequences of the videos are made with scene "off" and "auto", the same cameras and the default flow. CPU times are
those of one thread. Real videos have no true flow: endpoint errors are against dense inverse search at half the size
(dis-fast-1), on three voxel grids of each clip.

Bars: flow takes at least 30 % less CPU over all videos, and the median endpoint error rises by at most 0.05 px.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_videos, add_whole, beyond, progress
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.flow import flow_for, one_thread
from v2v_server.schedule import SequenceTable
from v2v_server.worker.job import ClipJob
from v2v_server.worker.making.read import Decoded, decode_for
from v2v_server.worker.scene_choice import TOLERANCE_PX
from v2v_tools.remake import lease_for

LEAST_SAVED = 0.3
SCENES: tuple[Literal["off"], Literal["auto"]] = ("off", "auto")
_REFERENCE = "dis-fast-1"
_COMPARED_VOXELS = 3


def clips_of(catalogue: Catalogue, specs: Sequence[StreamSpec], most: int) -> Iterator[dict[str, Any]]:
    """Yield one record for each sequence under scene "auto", at most ``most`` of each video; skip what fails.

    Args:
        specs: of scene "off" and "auto".
    """
    table = SequenceTable(catalogue.videos, catalogue.rows, specs[1])
    taken: Counter[str] = Counter()
    for rank in range(table.count):
        sequence = table[rank]
        taken[sequence.video.id] += 1
        if taken[sequence.video.id] > most:
            continue
        leases = [
            lease_for(
                Request(b"", 0, rank), sequence=sequence, catalogue=catalogue, spec=spec, seed=0,
                arrays=("voxels", "flow"),
            )
            for spec in specs
        ]  # fmt: skip
        try:
            yield _record_of(leases, catalogue.source)
        except VideoError as error:
            progress(f"left out: {error}")


def _record_of(leases: Sequence[Lease], source: VideoSource) -> dict[str, Any]:
    record: dict[str, Any] = {"measure": "clip", "video": leases[1].video, "start_frame": leases[1].start_frame}
    flows = []
    for scene, lease in zip(SCENES, leases, strict=True):
        clip = ClipJob.of(lease)
        decoded = decode_for(clip, lease.indices, source)[0]
        started = time.process_time()
        flows.append(_flow(clip, decoded))
        record[f"flow_{scene}_cpu_seconds"] = time.process_time() - started
        plan = decoded.plan.flow_plan
        if scene == "off":
            truth = _flow(clip, decoded, _REFERENCE)
    compared = np.linspace(0, len(truth) - 1, _COMPARED_VOXELS).round().astype(int)
    for scene, flow in zip(SCENES, flows, strict=True):
        error = np.linalg.norm(flow[compared] - truth[compared].astype(np.float32), axis=1)
        record[f"error_{scene}_median_px"] = float(np.median(error))
    record["added_error_median_px"] = record["error_auto_median_px"] - record["error_off_median_px"]
    record["saved_share"] = 1 - record["flow_auto_cpu_seconds"] / record["flow_off_cpu_seconds"]
    return record | {"decision": "" if plan is None else plan.reason.partition(";")[0]}


def _flow(clip: ClipJob, decoded: Decoded, method: str | None = None) -> npt.NDArray[np.float16]:
    """Return flow [T, 2, H, W] as a worker makes it, or by one method."""
    plan = decoded.plan
    assert plan.flow is not None  # the lease asks for flow
    settings = plan.flow if method is None else replace(plan.flow, method=method)
    methods = plan.flow_plan.methods if plan.flow_plan is not None and method is None else ()
    return flow_for(decoded.clip.frames, plan.params, clip.spec.recipe, settings, plan=methods).flow


def total_of(clips: Sequence[Record]) -> dict[str, Any]:
    """Return the means of the cost of flow with scene off and auto, and the error that auto adds."""
    off, auto = (float(np.mean([clip[f"flow_{scene}_cpu_seconds"] for clip in clips])) for scene in SCENES)
    added = [clip["added_error_median_px"] for clip in clips]
    return {
        "measure": "all", "samples": len(clips), "flow_off_cpu_seconds": off, "flow_auto_cpu_seconds": auto,
        "saved_share": 1 - auto / off, "added_error_median_px": float(np.median(added)),
        "added_error_worst_clip_px": max(added),
    }  # fmt: skip


_CLIPS: tuple[Column, ...] = (
    ("video", "video", "{}", 1),
    ("start_frame", "from", "{}", 1),
    ("decision", "decision", "{}", 1),
    ("flow_off_cpu_seconds", "flow off ms", "{:.1f}", 1e3),
    ("flow_auto_cpu_seconds", "auto ms", "{:.1f}", 1e3),
    ("saved_share", "saved", "{:.0%}", 1),
    ("error_off_median_px", "error off px", "{:.3f}", 1),
    ("added_error_median_px", "added px", "{:+.3f}", 1),
)
_TOTAL: tuple[Column, ...] = (
    ("samples", "samples", "{}", 1),
    ("flow_off_cpu_seconds", "flow off ms", "{:.2f}", 1e3),
    ("flow_auto_cpu_seconds", "auto ms", "{:.2f}", 1e3),
    ("saved_share", "saved", "{:.1%}", 1),
    ("added_error_median_px", "added error px", "{:+.4f}", 1),
    ("added_error_worst_clip_px", "worst clip px", "{:+.3f}", 1),
)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "real videos")
    add_whole(parser, "--sequences", 3, "most sequences of each video")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: no video gives a sequence.
    """
    recipe = Recipe(voxels_per_clip=8)  # short clips, so that videos of two seconds take part
    specs = [StreamSpec(recipe=recipe, scene=scene) for scene in SCENES]
    with (
        tempfile.TemporaryDirectory() as folder,
        one_thread(),
        closing(open_catalogue(asked.videos, cache_dir=folder, scene=True, processes=1)) as catalogue,
    ):
        clips = list(clips_of(catalogue, specs, asked.sequences))
    if not clips:
        raise UsageError(f"--videos {asked.videos}: no video gives a sequence of {recipe.frames_needed} frames")
    total = total_of(clips)
    missed = beyond("flow", total, least={"saved_share": LEAST_SAVED}, most={"added_error_median_px": TOLERANCE_PX})
    return Report([total, *clips], [(clips, _CLIPS), ([total], _TOTAL)], missed=missed)
