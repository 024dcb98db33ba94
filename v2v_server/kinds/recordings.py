"""A recording of an event camera, prepared: ``--videos-kind recordings``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import ARRAYS
from v2v_protocol.settings import format_value, number, settings_of, text
from v2v_protocol.spec import StreamSpec
from v2v_server.kinds.kind import RATE, VideosKind
from v2v_server.store.pixels import Pixels

if TYPE_CHECKING:
    from v2v_server.simulation.precision import Variant
    from v2v_server.video.probe import VideoFacts

_OBEYED = re.compile(
    "voxels_per_clip|bins|grids_per_frame|voxel_seconds|lead_.*|frame_stride|crop_.*|flip_.*|pause_.*|bin_span|added_.*"
    "|max_boxes|track_points"
)
"""Fields of a recipe that hold for recordings. All others belong to the simulation."""
_MARKS = re.compile(r"pictures|flow|[1-9]\d{0,11}events")
_PREPARES = "v2v-prepare SRC DST --videos-kind recordings"


@dataclass(frozen=True)
class RecordingKind(VideosKind):
    """A prepared recording, whose frames are marks: moments at which voxel grids may begin and end.

    Raises:
        UsageError: the marks have another form, or a rate too.
    """

    name = "recordings"
    help = "a recording of an event camera"
    forms = ("recording",)
    endings = (".v2ve",)
    looked_for = f".v2ve, the form that {_PREPARES} makes of recordings"
    has_sidecars = has_scenes = has_motion = is_simulated = False
    unprepared = f"recordings are prepared from their raw files: {_PREPARES}"
    converter = "v2v_server.prepare_recordings"

    rate: float = number(*RATE, unit="Hz", metavar="N")
    marks: str = text(
        "pictures",
        "where voxel grids of recordings begin and end: at their pictures, at the fields of their true flow (flow), or "
        "every N events (20000events); --rate N: N times a second",
        metavar="MARKS",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _MARKS.fullmatch(self.marks):
            raise UsageError(f"--marks {self.marks}: give pictures, flow, or a number and events, such as 20000events")
        if self.rate and self.marks != "pictures":
            raise UsageError(f"--marks {self.marks} and --rate {self.rate:g} both state the marks: give one of them")

    @property
    def _stated(self) -> str:
        return f"{self.rate:g}Hz" if self.rate else self.marks

    def open_pixels(self, path: Path) -> AbstractContextManager[Pixels]:
        """Lend the recording, with these marks."""
        found: AbstractContextManager[Pixels] = import_module("v2v_server.store.recording").RecordedPixels(
            path, self.marks, self.rate
        )
        return found

    def with_flags(self, facts: VideoFacts, rate: float) -> VideoFacts:
        """Name the marks.

        Raises:
            VideoError: there are fewer than two.
        """
        if facts.frames < 2:
            has = "too few events" if self.rate or self.marks.endswith("events") else f"fewer than two {self.marks}"
            raise VideoError(
                "", None, f"has {has} for marks at {self._stated}: give --rate or --marks (pictures, flow, 20000events)"
            )
        return replace(facts, content=f"{facts.content}@{self._stated}")

    def refuses(self, spec: StreamSpec) -> str:
        """Return which field of the simulation is set, or that a grid has no end."""
        recipe, plain = spec.recipe, preset("recordings")
        for name in settings_of(Recipe):
            value = getattr(recipe, name)
            if not _OBEYED.fullmatch(name) and value != getattr(plain, name):
                return (
                    f"recipe {name} = {format_value(value)} is a field of the simulation, and a recording has its own "
                    "noise, light and pixels: begin with --preset recordings; added_sigma and added_hot_share add noise"
                )
        if not (recipe.grids_per_frame or recipe.is_timed):
            return "a voxel grid of a recording lies between two marks: set grids_per_frame 1, or voxel_seconds"
        if spec.substep_px:
            return f"substep_px = {spec.substep_px} divides frames, and recordings have events: set it to 0"
        if recipe.is_noisy and spec.voxel_dtype.startswith("int"):
            return f"added noise is no whole number, and voxel_dtype is {spec.voxel_dtype}: set it to float32"
        return ""

    def cannot(self) -> Mapping[str, str]:
        """Return colour, tracks and labels."""
        labels = {name for name, form in ARRAYS.items() if form.needs.sidecars}
        return {
            **super().cannot(),
            "frames_rgb": "the colour of a video, and pictures of recordings are grey: ask for frames",
            **dict.fromkeys(labels, "labels beside a video: ask for frames or flow"),
        }

    def variants(self, found: frozenset[Variant]) -> frozenset[Variant]:
        """Return none: nothing is simulated."""
        return frozenset()


KIND = RecordingKind()
