"""Which rows of the upright picture may be used: WebVid's watermark, for one, sits in the lower half."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal

from v2v_protocol.errors import UsageError

_NUMBER = r"(\d+(?:\.\d*)?|\.\d+)"
_TOP_PIXELS = re.compile(r"top:(\d+)px")
_TOP_SHARE = re.compile(rf"top:{_NUMBER}")
_BAND = re.compile(rf"{_NUMBER}:{_NUMBER}")


@dataclass(frozen=True, slots=True)
class Rows:
    """A band of rows, as shares of the picture's height, or as a number of rows from the top.

    Attributes:
        top, bottom: shares of the height, 0 <= top < bottom <= 1.
        top_px: number of rows from the top, whatever the height; None: use ``top`` and ``bottom``.

    Raises:
        UsageError: a band without rows, or outside the picture.
    """

    top: float = 0.0
    bottom: float = 1.0
    top_px: int | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.top) and math.isfinite(self.bottom) and 0 <= self.top < self.bottom <= 1):
            raise UsageError(
                f"rows {self.top:g}:{self.bottom:g}: give two shares of the height, 0 <= top < bottom <= 1"
            )
        if self.top_px is not None and (self.top_px < 1 or (self.top, self.bottom) != (0.0, 1.0)):
            raise UsageError(f"rows top:{self.top_px}px: give at least one row")

    @classmethod
    def parse(cls, text: str) -> Rows:
        """From what a user writes: ``full``, ``top:0.54``, ``top:180px`` or ``0.1:0.6``.

        Raises:
            UsageError: it is none of these.
        """
        text = text.strip()
        if text == "full":
            return cls()
        if match := _TOP_PIXELS.fullmatch(text):
            return cls(top_px=int(match[1]))
        if match := _TOP_SHARE.fullmatch(text):
            return cls(bottom=float(match[1]))
        if match := _BAND.fullmatch(text):
            return cls(float(match[1]), float(match[2]))
        raise UsageError(f"rows {text!r}: write full, top:0.54 (share of the height), top:180px or 0.1:0.6")

    def bounds(self, height: int) -> tuple[int, int]:
        """(first row, row after the last) in a picture of that height: int(height * share), as the released code
        rounds.

        Raises:
            UsageError: no row is left, or the picture has fewer rows than asked.
        """
        if self.top_px is not None:
            if self.top_px > height:
                raise UsageError(f"rows {self}: the picture has {height} rows only")
            return 0, self.top_px
        top, bottom = int(height * self.top), int(height * self.bottom)
        if top >= bottom:
            raise UsageError(f"rows {self}: no row is left of a picture of {height} rows")
        return top, bottom

    def __str__(self) -> str:
        """Return the canonical text, which :meth:`parse` reads back."""
        if self.top_px is not None:
            return f"top:{self.top_px}px"
        if (self.top, self.bottom) == (0.0, 1.0):
            return "full"
        return f"top:{_plain(self.bottom)}" if self.top == 0 else f"{_plain(self.top)}:{_plain(self.bottom)}"


def _plain(share: float) -> str:
    """Return the shortest decimal that reads back as the same float, never in scientific notation."""
    return f"{Decimal(repr(share)):f}"
