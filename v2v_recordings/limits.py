"""What the forms of recordings can hold, for readers and writers."""

from __future__ import annotations

from typing import NamedTuple

from v2v_protocol.errors import UsageError

LARGER = "their events were folded into these when it was written; write it in another form, such as .h5"
"""Advice for a file that states a larger picture."""


class Limit(NamedTuple):
    """Limits of a form.

    Attributes:
        side_px: largest width and height of a picture.
        end_us: times are below this.
    """

    side_px: int
    end_us: int = 1 << 62


FORM_LIMITS = {
    "EVT 2": Limit(1 << 11),
    "EVT 3": Limit(1 << 11, 1 << 35),
    "DAT": Limit((1 << 14) - 1, 1 << 32),
    "AEDAT 4": Limit((1 << 15) - 1),
    "Event Stream": Limit((1 << 16) - 1),
    "DSEC's layout": Limit(1 << 16),
    "npz": Limit(1 << 16),
    "E2VID's layout": Limit(1 << 16, 1 << 52),
    "EVREAL's layout": Limit(1 << 16, 1 << 52),
}
"""Coordinates have 11 bits in EVT and 14 in DAT, and are int16 in AEDAT 4 and uint16 in the others. The package faery
writes the size of DAT, AEDAT 4 and Event Stream into a field of the same width. Times of DAT have 32 bits; 9.5 hours of
EVT 3 have 17 MB of words of time. Seconds in float64 tell microseconds apart for longer than a century."""


def fits(form: str, width_px: int, height_px: int) -> bool:
    """Return whether a form can hold pictures of this size."""
    return max(width_px, height_px) <= FORM_LIMITS[form].side_px


def check_size(where: str, form: str, width_px: int, height_px: int, advice: str) -> None:
    """Check that a form can hold pictures of this size; ``where`` begins the error message and ``advice`` ends it.

    Raises:
        UsageError: it cannot.
    """
    if not fits(form, width_px, height_px):
        most = f"{form} holds at most {FORM_LIMITS[form].side_px} px a side"
        raise UsageError(f"{where}: a picture of {width_px} x {height_px} px; {most}: {advice}")
