"""Packets that hold no picture to show: the alternate reference frames of VP8 and VP9.

Encoders store them so that later frames can refer to them; a decoder swallows them without output, so they must not be
counted as frames. (AV1 puts them into the temporal unit of a shown frame; H.26x has none.)
"""

from __future__ import annotations


def is_hidden(codec: str, packet: memoryview) -> bool:
    """Whether the packet decodes to nothing. Sources: RFC 6386 section 9.1; VP9 bitstream specification, section 6.2
    and annex B."""
    if codec == "vp8":
        return not packet[0] & 0x10  # show_frame is bit 4 of the frame tag
    if codec == "vp9":
        if packet[-1] & 0xE0 == 0xC0:  # a superframe's index ends the packet; one of its frames is shown
            return False
        return _vp9_hidden(packet[0])
    return False


def _vp9_hidden(first: int) -> bool:
    # Bits of the uncompressed header: marker (2), profile (2), reserved (profile 3 only), show_existing, type, show.
    at = 5 if first & 0x30 == 0x30 else 4
    show_existing, show = first >> (7 - at) & 1, first >> (5 - at) & 1
    return not show_existing and not show
