"""Numbered pictures in a folder or an archive: ``--videos-kind sequences``."""

from __future__ import annotations

import posixpath
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from v2v_protocol.errors import VideoError
from v2v_protocol.settings import number, whole
from v2v_server.kinds.kind import RATE, VideosKind, at_rate
from v2v_server.store.pixels import IMAGE_SUFFIXES

if TYPE_CHECKING:
    from v2v_server.video.probe import VideoFacts

_READER = 3
"""Raise it with every change of what probing a sequence finds: they are probed again."""
_QUESTIONED_BITS = 14
"""Pictures of 16 bits that need no more than these are questioned."""


@dataclass(frozen=True)
class SequenceKind(VideosKind):
    """A folder, whose id ends with a slash, or a ZIP archive."""

    name = "sequences"
    help = "a folder, or a zip archive, of numbered pictures"
    forms = "store_file", "picture_sequence"
    endings = "/", ".zip"
    looked_for = f"folders and .zip archives of numbered {' '.join(sorted(IMAGE_SUFFIXES))}"
    has_parts = has_listed_rates = True

    rate: float = number(*RATE, unit="Hz", metavar="N")
    picture_bits: int = whole(
        0, 8, 15,
        "bits, 8 to 15, that the levels of picture sequences of 16 bits hold, such as 12 for 0 to 4095; 0: all 16",
        off=True, metavar="N",
    )  # fmt: skip

    def id_of(self, path: str) -> str:
        """Return an archive's own path, or a picture's folder with a slash; "" for other files."""
        from v2v_server.store.picture_sequence import is_picture  # lazily: it loads the decoder

        if is_picture(path):
            return f"{posixpath.dirname(path)}/"
        return path if path.lower().endswith(".zip") else ""

    def listed_id(self, path: PurePosixPath) -> str:
        """Return the path of an archive; any other path names a folder."""
        return str(path) if path.suffix.lower() == ".zip" else f"{path}/"

    def rate_of(self, listed: float | None) -> float:
        """Return the list's rate, or else that of the flag."""
        return listed or self.rate

    def with_flags(self, facts: VideoFacts, rate: float) -> VideoFacts:
        """Add the rate, and the bits of pictures of 16; if none are stated, ask whether they hold fewer.

        Raises:
            VideoError: a picture needs more bits.
        """
        highest, bits, remark = facts.highest_level, self.picture_bits, ""
        if bits and highest >> bits > 0:
            raise VideoError("", None, f"has a level of {highest}, beyond those of --picture-bits {bits}")
        if bits and highest >= 0:
            index = replace(facts.index, bits=bits)
            return at_rate(replace(facts, index=index, content=f"{facts.content}~{bits}"), rate, facts.frames)
        if bits and not facts.made_of:
            remark = f"--picture-bits {bits} does not apply: its pictures do not have 16 bits"
        elif 0 <= highest < 1 << _QUESTIONED_BITS:
            least = max(8, highest.bit_length())
            remark = f"no level above {highest} of 65535 in the pictures looked at: if they hold {least} bits, they "
            remark += f"are {1 << 16 - least} times too dark, and --picture-bits {least} stretches them"
        return at_rate(replace(facts, remark="; ".join(filter(None, (facts.remark, remark)))), rate, facts.frames)

    def mark(self, rate: float) -> int:
        """Return a number of the rate and the bits."""
        return _READER + int(1e6 * rate) + (self.picture_bits << 44)


KIND = SequenceKind()
