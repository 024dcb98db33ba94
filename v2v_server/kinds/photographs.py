"""A picture that the camera of each sample moves over: ``--videos-kind photographs``."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from v2v_protocol.errors import UsageError
from v2v_protocol.sample import ARRAYS
from v2v_protocol.settings import number
from v2v_protocol.spec import StreamSpec
from v2v_server.kinds.kind import RATE, VideosKind, at_rate
from v2v_server.store.pixels import IMAGE_SUFFIXES

if TYPE_CHECKING:
    from v2v_server.simulation.precision import Variant
    from v2v_server.video.probe import VideoFacts

LONGEST_PHOTOGRAPH_FRAMES = 2**17


@dataclass(frozen=True)
class PhotographKind(VideosKind):
    """A photograph, whose frames are rendered for each sample.

    Raises:
        UsageError: rate and duration give too few frames, or too many.
    """

    name = "photographs"
    help = "a picture that the camera moves over"
    forms = ("photograph",)
    endings = tuple(sorted(IMAGE_SUFFIXES))
    looked_for = " ".join(endings)
    has_sidecars = has_scenes = has_motion = False
    is_view = True
    shown_arrays = "masks", "tracks"
    unprepared = "photographs are rendered for each sample, so there is nothing to prepare: serve them"

    rate: float = number(*RATE, unit="Hz", metavar="N")
    photograph_seconds: float = number(
        0.0, 0.0, 1e6, "time for which each photograph is shown; 0: 10", unit="s", metavar="S"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.frames <= LONGEST_PHOTOGRAPH_FRAMES:
            raise UsageError(
                f"--photograph-seconds {self.photograph_seconds or 10:g} at --rate {self.rate_of(None):g} gives "
                f"{self.frames} frames: give 2 to {LONGEST_PHOTOGRAPH_FRAMES}"
            )

    @property
    def frames(self) -> int:
        """Return the number of frames, those at the beginning and the end included."""
        return 1 + math.floor(min((self.photograph_seconds or 10.0) * self.rate_of(None), 1e15) + 0.5)

    def rate_of(self, listed: float | None) -> float:
        """Return the rate at which all of them are shown."""
        return self.rate or 60.0

    def with_flags(self, facts: VideoFacts, rate: float) -> VideoFacts:
        """Return the facts of all frames that it is shown for."""
        return at_rate(facts, rate, self.frames)

    def mark(self, rate: float) -> int:
        """Return a number of rate and duration."""
        return 1 + zlib.crc32(f"{rate} {self.frames}".encode())

    def refuses(self, spec: StreamSpec) -> str:
        """Return that nothing moves without a world."""
        if spec.recipe.is_world:
            return super().refuses(spec)
        return "photographs stand still under this recipe: set world fields, as --preset worlds does"

    def least_hz(self, spec: StreamSpec) -> float:
        """Return 0: light is known at any time."""
        return 0.0

    def cannot(self) -> Mapping[str, str]:
        """Return colour, and the labels of files."""
        labels = {name for name, form in ARRAYS.items() if form.needs.sidecars and name != "masks"}
        return {
            "frames_rgb": "the colour of a video, and photographs are rendered in grey: ask for frames",
            **dict.fromkeys(labels, "labels beside a video, and photographs move: ask for masks and tracks"),
        }

    def reads(self, spec: StreamSpec, height_px: int, width_px: int) -> tuple[int, int]:
        """Return the crop, whose levels take two bytes."""
        return spec.recipe.crop_height_px * spec.recipe.crop_width_px, 2

    def variants(self, found: frozenset[Variant]) -> frozenset[Variant]:
        """Return the kernels for rendered frames of 12 bits, whose levels are rendered too."""
        from v2v_server.video.picture import MOST_BITS

        return frozenset(each._replace(is_divided=False, bits=MOST_BITS, is_rendered=True) for each in found)


KIND = PhotographKind()
