"""Find signs that a list of packets is not the list of frames, without decoding. A false alarm costs one decoding pass.

Sources: ITU-T H.264 and H.265, 7.3; RFC 6386, 9.1; VP9 bitstream specification, 6.2; AV1 bitstream specification, 5.3;
ISO/IEC 13818-2, 6.2.2.1; ISO/IEC 14496-2, 6.2; ITU-T T.81, B.2.2.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from av.packet import Packet
from av.video.stream import VideoStream

from v2v_server.video.frame_index import NO_TIMESTAMP
from v2v_server.video.packets import behind_lengths

_LONGEST_REORDERING = 16
"""Frames by which a decoder may move one: the largest picture buffer of H.264 and HEVC."""
_GAP_STEPS = 8
"""A step of more than this many median steps is a gap."""
_HEAD_BYTES = 4096
_NOT_CODED_BYTES = 8
"""Longest MPEG-4 picture that is not coded, behind its start code."""

_SIZES = {
    "mpeg1video": re.compile(rb"\x00\x00\x01\xb3(...)", re.DOTALL),
    "mpeg2video": re.compile(rb"\x00\x00\x01\xb3(...)", re.DOTALL),
    "mpeg4": re.compile(rb"\x00\x00\x01[\x20-\x2f](.*?)\x00\x00\x01", re.DOTALL),
    "mjpeg": re.compile(rb"\xff[\xc0-\xc2]\0.\x08(....)", re.DOTALL),
    "vp8": re.compile(rb"\A...\x9d\x01\x2a(....)", re.DOTALL),
    "vp9": re.compile(rb"\A.\x49\x83\x42(.{5})", re.DOTALL),
    "av1": re.compile(rb"\A(?:\x12\0)?\x0a(.{10})", re.DOTALL),
}
"""Patterns of the headers that hold the size of the picture, by codec."""
_SPS = {"h264": (0, 0x1F, 7), "hevc": (1, 0x3F, 33)}
"""(shift, mask, type) that identify a sequence parameter set by the first byte of its NAL unit."""
_VOP = b"\0\0\1\xb6"


class PacketSigns:
    """Read the packets of a track.

    Attributes:
        picture_changes: whether a packet states another picture than an earlier one.
        empty_pts: time stamps of packets that may decode to nothing.

    Args:
        stream: the track.
    """

    def __init__(self, stream: VideoStream) -> None:
        self.picture_changes = False
        self.empty_pts = array("q")
        self._codec = stream.codec_context.codec.canonical_name
        self._extradata = stream.codec_context.extradata or b""
        self._stated = b""
        self._begun = False

    def read(self, packet: Packet[VideoStream], content: memoryview) -> None:
        """Read the next packet in stored order."""
        if packet.is_keyframe:
            self.picture_changes |= self._states_another(packet, content)
        elif self._codec == "vp9":
            self.picture_changes |= is_scaled(content)
        elif packet.pts is not None and may_be_not_coded(self._codec, content):
            self.empty_pts.append(packet.pts)
        self._begun = True

    def _states_another(self, packet: Packet[VideoStream], content: memoryview) -> bool:
        stated = self._size(content)
        if not self._begun:
            self._stated = stated
            return False
        if packet.has_sidedata("new_extradata"):
            return True
        return bool(stated) and stated != self._stated and stated not in self._extradata

    def _size(self, content: memoryview) -> bytes:
        """Return the bytes that state the size of a packet's picture; empty if it has none."""
        head = content[:_HEAD_BYTES]
        if self._codec in _SPS:
            shift, mask, kind = _SPS[self._codec]
            units = _nal_units(head, self._codec, self._extradata)
            return next((unit for unit in units if unit and unit[0] >> shift & mask == kind), b"")
        pattern = _SIZES.get(self._codec)
        found = pattern.search(head) if pattern else None
        return found[1] if found else b""


def is_scaled(packet: memoryview) -> bool:
    """Return whether the first frame of a VP9 packet refers to frames of other sizes only: 6.2 and 7.2.5."""
    head = "".join(f"{byte:08b}" for byte in packet[:8])
    at = 5 if head[2:4] == "11" else 4  # profile 3 has a reserved bit
    shows_existing, is_inter, is_shown, is_resilient = (bit == "1" for bit in head[at : at + 4])
    if shows_existing or not is_inter:
        return False
    at += 4
    if not is_shown:
        if head[at] == "1":
            return False  # intra only
        at += 1
    at += 0 if is_resilient else 2
    return head[at + 20 : at + 23] == "000"  # behind what it refreshes (8 bits) and its three references (4 each)


def may_be_not_coded(codec: str, packet: memoryview) -> bool:
    """Return whether a packet is too short for a picture: MPEG-4 says so where nothing changed, and decodes to nothing.

    VP8 and AV1 are left out: their shortest packets show a frame.
    """
    if codec in ("vp8", "av1"):
        return False
    if codec == "mpeg4":
        return _VOP in bytes(packet[-(len(_VOP) + _NOT_CODED_BYTES) :])
    return len(packet) <= _NOT_CODED_BYTES


def _nal_units(packet: memoryview, codec: str, extradata: bytes) -> Iterable[bytes]:
    at = 4 if codec == "h264" else 21  # ISO/IEC 14496-15, 5.3.3 and 8.3.3
    if len(extradata) > at and extradata[0] == 1:
        return map(bytes, behind_lengths(packet, (extradata[at] & 3) + 1))
    return (unit.rstrip(b"\0") for unit in bytes(packet).split(b"\0\0\1")[1:])


def times_are_doubtful(pts: npt.NDArray[np.int64], dts: npt.NDArray[np.int64], reorders: bool) -> bool:
    """Return whether time stamps contradict each other, or the decoder.

    Args:
        pts, dts: [n] int64 of the packets in stored order; a dts may be :data:`NO_TIMESTAMP`.
        reorders: whether the decoder says that it changes the order of frames.
    """
    if len(pts) < 2:
        return False
    displacement = np.abs(np.argsort(pts, kind="stable") - np.arange(len(pts)))
    known = dts[dts != NO_TIMESTAMP]
    return bool(
        np.any(known[1:] < known[:-1])
        or displacement.max() > _LONGEST_REORDERING
        or (reorders and not displacement.any())
    )


def steps_and_gaps(pts: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the steps between rising time stamps [n], at least two, and which of the n - 1 steps are gaps."""
    steps = np.diff(pts)
    return steps, steps > _GAP_STEPS * np.median(steps)
