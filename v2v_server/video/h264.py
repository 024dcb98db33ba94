"""Which H.264 packets nothing refers to, so that they need not be decoded on the way to a later frame.

The decoder's own option for this (``skip_frame``) would do, but it also turns damaged packets into skipped ones without
a word. Only the AVC form is read (mp4, mov, matroska, flv): NAL units behind their lengths; ISO/IEC 14496-15, 5.3.3.
"""

from __future__ import annotations

_SLICE = 1
_NO_PICTURE = frozenset({6, 9, 12})  # supplemental information, access unit delimiter, filler


def length_bytes(extradata: bytes | None) -> int:
    """Size of the length field in front of each NAL unit; 0 if the stream is not in AVC form."""
    return (extradata[4] & 3) + 1 if extradata and len(extradata) > 6 and extradata[0] == 1 else 0


def is_unreferenced(packet: memoryview, length_bytes: int) -> bool:
    """Whether the packet is well formed and holds slices of non-reference pictures only (nal_ref_idc 0, ITU-T H.264,
    7.4.1)."""
    at, slices = 0, 0
    while at + length_bytes < len(packet):
        size = int.from_bytes(packet[at : at + length_bytes], "big")
        header = packet[at + length_bytes]
        kind = header & 0x1F
        if kind == _SLICE and not header & 0xE0:  # forbidden_zero_bit and nal_ref_idc
            slices += 1
        elif kind not in _NO_PICTURE:
            return False
        at += length_bytes + size
    return slices > 0 and at == len(packet)
