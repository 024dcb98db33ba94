"""A corpus without files: a catalogue of videos that exist only by name, for what never opens one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np

from v2v_protocol.errors import IndexUnreadable, ProtocolError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, CorpusPart
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.videos import CorpusFacts, Sidecars, VideoEntry
from v2v_server.kinds.registry import kind_of
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.rows import Rows

SMALL = Recipe(voxels_per_clip=2, bins=2, crop_height_px=8, crop_width_px=8)
"""Needs 5 frames of 8 x 8 pixels."""
SMALL_SPEC = StreamSpec(recipe=SMALL)


def video(name: str, frames: int = 100, height_px: int = 16, width_px: int = 16, rate: float = 25.0) -> VideoEntry:
    """An entry of a catalogue."""
    return VideoEntry(name, f"fingerprint of {name}", frames, width_px, height_px, rate, "h264")


@dataclass(frozen=True)
class NamedCorpus:
    """What the pure parts of the server use of a :class:`Catalogue`."""

    videos: tuple[VideoEntry, ...]
    rows: Rows = field(default_factory=Rows)
    refusals: tuple[Refusal, ...] = ()
    source: VideoSource = field(default_factory=lambda: Folder(Path("/corpus")))
    digest: str = "c" * 32
    unreadable: frozenset[str] = frozenset()
    held: set[str] = field(default_factory=set)
    notes: tuple[str, ...] = ()
    sidecars: Mapping[str, Sidecars] = field(default_factory=dict)

    def fail_fast(self) -> None:
        """There is no index to wait for."""

    @property
    def facts(self) -> CorpusFacts:
        """What is known in memory; these videos have no statistics."""
        missing = kind_of(self.videos[0].id).cannot()
        return CorpusFacts(self.videos, self.rows, self.digest, None, self.sidecars, missing)

    def part(self) -> CorpusPart:
        return CorpusPart(str(self.source), len(self.videos), len(self.refusals))

    def digest_under(self, scene: str) -> str:
        return self.facts.digest_under(scene)

    def state(self, name: str) -> None:
        """Return nothing: there is no file."""

    def frame_index_bytes(self, name: str, start: int, count: int) -> bytes:
        return self.frame_index(name).slice(start, count).to_bytes()

    def frame_index(self, name: str) -> FrameIndex:
        """A regular index with a keyframe at every twelfth frame."""
        if name in self.unreadable:
            raise ProtocolError(f"the index of {name} is damaged")
        if name in self.held:
            raise IndexUnreadable("the catalogue's index cannot be read: database is locked")
        entry = next(entry for entry in self.videos if entry.id == name)
        keyframes = np.arange(0, entry.frames, 12, dtype=np.int64)
        pts = np.arange(entry.frames, dtype=np.int64)
        return FrameIndex(0, pts, keyframes, keyframes, (1, 25), entry.height_px, entry.width_px, seekable=True)


def corpus(
    *videos: VideoEntry,
    rows: str = "full",
    unreadable: tuple[str, ...] = (),
    held: set[str] | None = None,
    sidecars: Mapping[str, Sidecars] = MappingProxyType({}),
) -> Catalogue:
    """A catalogue of these videos; ``held`` may change later."""
    named = NamedCorpus(
        videos,
        Rows.parse(rows),
        unreadable=frozenset(unreadable),
        held=set() if held is None else held,
        sidecars=sidecars,
    )
    return cast(Catalogue, named)
