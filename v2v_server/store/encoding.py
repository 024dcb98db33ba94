"""Settings of a prepared corpus: lossless store files, or small H.264 files."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.errors import UsageError
from v2v_server.store.packing import SIZES

LOSSLESS, H264 = "lossless", "h264"
DEFAULT_QUALITY, DEFAULT_GOP, DEFAULT_SIZE = 18, 25, "dense"
_LOWEST_QUALITY = 51
_LONGEST_GOP = 600


@dataclass(frozen=True, slots=True)
class Encoding:
    """How a prepared corpus stores its pictures.

    Attributes:
        codec: "lossless" (store files) or "h264".
        size: lossless: a key of :data:`v2v_server.store.packing.SIZES`; otherwise empty.
        quality: h264: x264's rate factor, lower is better and larger; otherwise 0.
        gop: h264: distance of keyframes, frames. Decoding a random range starts up to this many frames early. Otherwise
            0.

    Raises:
        UsageError: the codec is unknown, or a setting does not belong to it or is outside its limits.
    """

    codec: str = LOSSLESS
    size: str = ""
    quality: int = 0
    gop: int = 0

    def __post_init__(self) -> None:
        if self.codec == LOSSLESS:
            if self.size not in SIZES or self.quality or self.gop:
                raise UsageError(f"{self}: lossless has a size, one of {', '.join(SIZES)}, and no quality or gop")
        elif self.codec == H264:
            if self.size or not 1 <= self.quality <= _LOWEST_QUALITY:
                raise UsageError(f"{self}: h264 has no size, and a quality (rate factor) of 1 .. {_LOWEST_QUALITY}")
            if not 1 <= self.gop <= _LONGEST_GOP:
                raise UsageError(f"gop {self.gop}: give 1 .. {_LONGEST_GOP} frames")
        else:
            raise UsageError(f"codec {self.codec!r}: choose {LOSSLESS} or {H264}")

    @classmethod
    def of(cls, codec: str, size: str | None = None, quality: int | None = None, gop: int | None = None) -> Encoding:
        """Return an encoding from the given settings and the codec's defaults for the others.

        Raises:
            UsageError: see the class.
        """
        if codec == LOSSLESS:
            return cls(codec, DEFAULT_SIZE if size is None else size, quality or 0, gop or 0)
        return cls(
            codec, size or "", DEFAULT_QUALITY if quality is None else quality, DEFAULT_GOP if gop is None else gop
        )

    @property
    def is_lossless(self) -> bool:
        """Return whether the files reproduce the exact pixels of their sources."""
        return self.codec == LOSSLESS

    def __str__(self) -> str:
        return f"lossless {self.size}" if self.is_lossless else f"{self.codec} quality {self.quality} gop {self.gop}"
