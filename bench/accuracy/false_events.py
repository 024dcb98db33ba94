"""Events that defects of a video add or take away, and samples that are mostly noise, with and without scene "auto"."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tests.oracles.rendered import Reals, log_levels
from v2v_protocol.errors import VideoError
from v2v_protocol.recipe import preset
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.videos import VideoEntry, encoded_pieces
from v2v_server.schedule import SequenceTable
from v2v_server.simulation import simulate, simulate_log
from v2v_server.simulation.forms import warm_up
from v2v_server.video.rows import Rows
from v2v_server.worker.scene_choice import CleanFrames
from v2v_tools.motion import quiet_voxels
from v2v_tools.remake import Remaker

Film = npt.NDArray[np.uint8]
THRESHOLD = 0.2
SCENES: tuple[Literal["off"], Literal["auto"]] = ("off", "auto")
SHARES = ((0.0, 1.0), (0.75, 1.0), (0.75, 0.25), (1.0, 0.25))
"""Values of ``moving_share`` and ``quiet_share``."""
_SEQUENCE = preset("noise-free").replace(voxels_per_clip=3, crop_height_px=64, crop_width_px=64)
_LOG = log_levels(np.arange(256) / 255.0)
_SAMPLE = preset("paper").replace(voxels_per_clip=8)


def sequences(
    clips: Sequence[Film], scenes: Sequence[Scene], scene: Literal["off", "auto"]
) -> Iterator[tuple[int, CleanFrames]]:
    """Yield the sequences that clips give: the number of the clip, and the frames.

    Args:
        clips, scenes: pictures of each clip, and what was found in them.
        scene: whether defects are left out.
    """
    spec = StreamSpec(recipe=_SEQUENCE, scene=scene)
    videos = [
        VideoEntry(
            str(number), "", len(clip), clip.shape[2], clip.shape[1], 30.0, "",
            pieces=encoded_pieces(found.pieces, found.end),
        )
        for number, (clip, found) in enumerate(zip(clips, scenes, strict=True))
    ]  # fmt: skip
    table = SequenceTable(videos, Rows.parse("full"), spec)
    for rank in range(table.count):
        number, start = int(table[rank].video.id), table[rank].start_frame
        frames = CleanFrames.of(scenes[number] if scene == "auto" else None, start, spec, _SEQUENCE.frames_needed)
        yield number, frames


def between(film: Film, positions: Reals) -> Reals:
    """Return log intensities [len(positions), h, w] at fractional frames of a film, linear in time."""
    before = positions.astype(np.int64)
    part = (positions - before)[:, None, None]
    mixed: Reals = (1 - part) * _LOG[film[before]] + part * _LOG[film[np.minimum(before + 1, len(film) - 1)]]
    return mixed


def compared(frames: Film, levels: Reals) -> npt.NDArray[np.int64]:
    """Simulate frames and the log intensities of the clean original.

    Returns:
        [4] number of events, of those that the original lacks, of the original's, of those that the frames lack; an
        event counts for its pixel and step.
    """
    camera: dict[str, Any] = {
        "threshold_pos": THRESHOLD, "bins": len(frames) - 1, "start_residual": 0.0, "dtype": "int16",
    }  # fmt: skip
    made, true = (each.voxels.astype(np.int64) for each in (simulate(frames, **camera), simulate_log(levels, **camera)))
    false, missing = (
        sum(int((np.maximum(sign * one, 0) - np.maximum(sign * other, 0)).clip(0).sum()) for sign in (1, -1))
        for one, other in ((made, true), (true, made))
    )
    return np.array([np.abs(made).sum(), false, np.abs(true).sum(), missing])


def noisy_samples(videos: Path, count: int) -> list[dict[str, Any]]:
    """Return one record for each of :data:`SHARES`: how many samples of the paper's cameras are mostly noise.

    A sample is if noise and hot pixels make most events of its voxel grid with the most events.
    """
    warm_up()
    records = []
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(open_catalogue(videos, cache_dir=folder, scene=True, processes=1)) as catalogue,
    ):
        for moving, quiet in SHARES:
            spec = StreamSpec(recipe=_SAMPLE, scene="auto", moving_share=moving, quiet_share=quiet)
            remaker, noisy = Remaker(catalogue, spec, ("voxels",)), list[bool]()
            for index in range(min(count, remaker.count)):
                with suppress(VideoError):
                    noisy.append(_is_mostly_noise(remaker, index))
            records.append(
                {"measure": "noise", "moving_share": moving, "quiet_share": quiet, "samples": len(noisy),
                 "noisy_share": float(np.mean(noisy))}
            )  # fmt: skip
    return records


def _is_mostly_noise(remaker: Remaker, index: int) -> bool:
    made = remaker.made(0, 0, index)
    each, quiet = (
        np.abs(voxels, dtype=np.float64).reshape(len(voxels), -1).sum(axis=1)
        for voxels in (made.sample.arrays["voxels"], quiet_voxels(made))
    )
    busiest = int(each.argmax())
    return bool(2 * quiet[busiest] < each[busiest])
