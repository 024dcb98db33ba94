"""What a video of a corpus is, as far as callers ask.

A kind is a file beside this one, named in :data:`v2v_server.kinds.registry.KIND_FILES`: a frozen dataclass that is a
:class:`VideosKind`, whose fields are its flags, and ``KIND``, an instance with their defaults. These files load no
decoder: the command lines import them.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from v2v_protocol.command import flag_of
from v2v_protocol.settings import Setting, check_settings, settings_of
from v2v_protocol.spec import MARGIN_PX, StreamSpec
from v2v_server.store.pixels import Pixels, open_pixels

if TYPE_CHECKING:  # a command line starts without the decoder
    from v2v_server.simulation.precision import Variant
    from v2v_server.video.probe import VideoFacts

RATE = (
    0.0, 0.0, 1e6,
    "rate of picture sequences without time stamps, 0: unknown; of photographs, 0: 60; of the marks of recordings, 0: "
    "as --marks states",
)  # fmt: skip
"""What kinds of pictures without times of their own state of their flag ``rate``, in Hz."""
LEAST_EXPOSED = 4
"""Frames of a video that an exposure lasts at least."""
_SUFFIX = re.compile(r"\.(?=.*[a-z]|26[45]$)[a-z0-9]+", re.IGNORECASE)


@dataclass(frozen=True)
class VideosKind:
    """What a video of a corpus is, and what a user states of it: each field is a flag, declared as a setting.

    Kinds may have a flag in common: with one meaning, limits and help. A worker has the id of a video only, and so the
    kind that owns it with all flags at their defaults. What a flag changes reaches it in the frame index
    (:meth:`with_flags`).

    Attributes:
        name: its ``--videos-kind``.
        help: what a video is, after "is".
        forms: files of ``v2v_server/store/`` that read a video, in the order in which they are asked.
        endings: of the ids of its videos, in lower case; no two kinds have one in common.
        archive_endings: of archives whose members may be videos, in lower case.
        looked_for: which files are videos, for messages.
        has_parts: whether a video may be a folder of files, whose id ends with a slash.
        has_listed_rates: whether a list may state the rate of a video.
        has_sidecars: whether arrays can be made from files beside a video.
        has_scenes: whether scenes are analysed, and defects of pictures looked for.
        has_motion: whether its pictures move as they stand, and not only under the camera of a sample.
        seeks_by_time: whether a frame is found by its time stamp; if it has none, all frames before it are decoded.
        is_view: whether its clips are what the camera of each sample sees, with the levels between frames and all
            that is known exactly (:class:`v2v_server.video.decode.DecodedClip`).
        is_simulated: whether its events are simulated, from its frames.
        shown_arrays: arrays of every video that a preview draws; empty: those of its sidecars.
        unprepared: why ``v2v-prepare`` does not take it; "" if it does.
        converter: module that makes its videos of other files for ``v2v-prepare``
            (:mod:`v2v_server.prepare_recordings`); "" if none does.

    Raises:
        UsageError: a flag is outside its limits.
    """

    name: ClassVar[str]
    help: ClassVar[str]
    forms: ClassVar[Sequence[str]]
    endings: ClassVar[tuple[str, ...]]
    archive_endings: ClassVar[tuple[str, ...]] = ()
    looked_for: ClassVar[str]
    has_parts: ClassVar[bool] = False
    has_listed_rates: ClassVar[bool] = False
    has_sidecars: ClassVar[bool] = True
    has_scenes: ClassVar[bool] = True
    has_motion: ClassVar[bool] = True
    seeks_by_time: ClassVar[bool] = False
    is_view: ClassVar[bool] = False
    is_simulated: ClassVar[bool] = True
    shown_arrays: ClassVar[Sequence[str]] = ()
    unprepared: ClassVar[str] = ""
    converter: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check_settings(self, flag_of)

    @property
    def settings(self) -> Mapping[str, Setting]:
        """Return the declarations of its own flags, by name."""
        kind: Any = type(self)
        return settings_of(kind)

    @property
    def flags(self) -> dict[str, Any]:
        """Return what makes it again, see :func:`v2v_server.kinds.registry.kind_from`."""
        return {"videos_kind": self.name, **{name: getattr(self, name) for name in self.settings}}

    @property
    def in_digest(self) -> str:
        """Return its part of a catalogue's digest."""
        return f"{self.name}\n"

    def id_of(self, path: str) -> str:
        """Return the id of the video that a file belongs to, by its relative path; "" if it belongs to none."""
        return path if path.lower().endswith(self.endings) else ""

    def entry_of(self, path: str) -> str:
        """Return the same; or the path, if the file is an archive whose members may be videos."""
        return self.id_of(path) or (path if path.endswith(self.archive_endings) else "")

    def listed_id(self, path: PurePosixPath) -> str:
        """Return the id of the video that a list names by this path; "" if it cannot name one."""
        return str(path) if _SUFFIX.fullmatch(path.suffix) else ""

    def open_pixels(self, path: Path) -> AbstractContextManager[Pixels]:
        """Lend the pixels of a file or folder of this host until the end of the context. Errors: :class:`Pixels`."""
        return open_pixels(path, self.forms)

    def rate_of(self, listed: float | None) -> float:
        """Return the rate of a video that states none, Hz; 0 if it is unknown. ``listed``: that of a list."""
        return listed or 0.0

    def with_flags(self, facts: VideoFacts, rate: float) -> VideoFacts:
        """Return what is known of a video once what the user states of it is added.

        What a flag changes must change ``content``, which names the video in digests, and the index.

        Args:
            facts: what the file states.
            rate: see :meth:`rate_of`.

        Raises:
            VideoError: the file contradicts it.
        """
        return facts

    def mark(self, rate: float) -> int:
        """Return 62 bits at most that change with all that :meth:`with_flags` uses: the index then probes again."""
        return 1 + zlib.crc32(repr((rate, self.flags)).encode()) if self.settings else 0

    def refuses(self, spec: StreamSpec) -> str:
        """Return why no sample of a spec can be made of such videos, and what to do; "" if it can."""
        for is_set, fields, kind in (
            (spec.recipe.is_world, "world fields", "photographs"),
            (spec.recipe.is_recorded, "fields bin_span and added_...", "recordings"),
        ):
            if is_set and kind != self.name:
                return f"the recipe's {fields} are for {kind}, these are {self.name}: add --videos-kind {kind}"
        return ""

    def least_hz(self, spec: StreamSpec) -> float:
        """Return the least rate of such videos whose samples can be made under a spec, frames a second; 0 for any."""
        exposure, stride = spec.recipe.exposure_seconds, spec.recipe.frame_stride
        return LEAST_EXPOSED * stride / exposure[0] if any(exposure) else 0.0

    def cannot(self) -> Mapping[str, str]:
        """Return the arrays that no such video gives, with what they need, and what to ask for instead."""
        return {"tracks": "--videos-kind photographs, where all motion is known: ask for flow, which is estimated"}

    def reads(self, spec: StreamSpec, height_px: int, width_px: int) -> tuple[int, int]:
        """Return how much a sample reads of each frame of this size: pixels, and the bytes of a level."""
        recipe, whole = spec.recipe, height_px * width_px
        sides = 2 * max(spec.flow_margin_px, MARGIN_PX if spec.substep_px else 0)
        window = min(whole, (recipe.crop_height_px + sides) * (recipe.crop_width_px + sides))
        is_whole = recipe.resize_scale != (1.0, 1.0) or spec.flow_margin_px < 0
        return whole if is_whole else window, 1 if recipe.light == "sdr" else 2

    def variants(self, found: frozenset[Variant]) -> frozenset[Variant]:
        """Return the kernels that its samples need, of those that samples of decoded frames would need."""
        return found


def at_rate(facts: VideoFacts, rate: float, frames: int) -> VideoFacts:
    """Return the facts of ``frames`` pictures that follow each other at a stated rate, Hz, if their file states no
    times.
    """
    if not rate or facts.index.seekable:
        return facts
    index = facts.index.timed(np.rint(np.arange(frames) * 1e9 / rate).astype(np.int64))
    content = f"{facts.content}@{rate:g}"
    return replace(facts, frames=frames, frames_per_second=rate, index=index, content=content)
