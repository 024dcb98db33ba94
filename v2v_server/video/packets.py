"""What a packet says without being decoded: whether it gives a frame of its own, whether anything refers to it, and
whether it is a sign that the list of packets is not the list of frames. A false alarm costs one decoding pass.

VP8 and VP9 hide alternate reference frames, which a decoder swallows without output. H.264 may store a picture as two
fields (PAFF, as AVCHD cameras do), each in a packet of its own, of which a decoder makes one frame. AV1 puts what it
hides into the unit of a shown frame; HEVC's fields are pictures of their own; of MPEG-2 and VC-1 libavformat puts both
fields into one packet.

Sources: RFC 6386, 9.1; VP9 bitstream specification, 6.2 and annex B; ITU-T H.264, 7.3 and 7.4; ITU-T H.265, 7.3; AV1
bitstream specification, 5.3; ISO/IEC 13818-2, 6.2.2.1; ISO/IEC 14496-2, 6.2; ITU-T T.81, B.2.2.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt
from av.packet import Packet
from av.video.stream import VideoStream

from v2v_server.video.frame_index import NO_TIMESTAMP

_SLICE, _IDR, _SPS, _PPS = 1, 5, 7, 8
_NO_PICTURE = frozenset({6, 9, 12})  # supplemental information, access unit delimiter, filler
_CHROMA_PROFILES = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244})
_START_CODE = re.compile(b"\0\0\1")
_HEADER_BYTES = 32
_LARGEST_SPS_BYTES = 512

_Picture = tuple[int, int]
"""(frame_num, structure) of a coded picture: 0 a frame, 1 a top, 2 a bottom field."""


def is_hidden(codec: str, packet: memoryview) -> bool:
    """Return whether a packet of VP8 or VP9 decodes to nothing; False of other codecs."""
    if codec == "vp8":
        return not packet[0] & 0x10  # show_frame is bit 4 of the frame tag
    if codec == "vp9":
        return not _vp9_shown(packet)
    return False


def _vp9_shown(packet: memoryview) -> bool:
    if packet[-1] & 0xE0 == 0xC0:  # a superframe's index ends the packet; one of its frames is shown
        return True
    # Bits of the uncompressed header: marker (2), profile (2), reserved (profile 3 only), show_existing, type, show.
    first = packet[0]
    at = 5 if first & 0x30 == 0x30 else 4
    show_existing, show = first >> (7 - at) & 1, first >> (5 - at) & 1
    return bool(show_existing or show)


def length_bytes(extradata: bytes | None) -> int:
    """Size of the length field in front of each NAL unit; 0 if the stream is not in AVC form (ISO/IEC 14496-15,
    5.3.3)."""
    return (extradata[4] & 3) + 1 if extradata and len(extradata) > 6 and extradata[0] == 1 else 0


def is_unreferenced(packet: memoryview, length_bytes: int) -> bool:
    """Return whether the packet is well formed, in AVC form, and holds slices of non-reference pictures only
    (nal_ref_idc 0, 7.4.1), so that it need not be decoded on the way to a later frame.

    The decoder's own option for this (``skip_frame``) also turns damaged packets into skipped ones without a word.
    """
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


class Fields:
    """Tells the second field of an H.264 picture from what begins a frame.

    Attributes:
        seen: whether any field has been met.

    Args:
        extradata: of the track: parameter sets in AVC form or behind start codes.
    """

    def __init__(self, extradata: bytes | None) -> None:
        self.seen = False
        self._length_bytes = length_bytes(extradata)
        self._sps: dict[int, tuple[int, bool, bool]] = {}  # bits of frame_num, colour planes apart, fields allowed
        self._pps: dict[int, int] = {}  # which SPS
        self._open: _Picture | None = None  # a field that waits for its other one
        if extradata and self._length_bytes:
            self._read_configuration(memoryview(extradata))
        elif extradata:
            for nal in _behind_start_codes(memoryview(extradata)):
                self._learn(nal)

    def begins_frame(self, packet: memoryview) -> bool:
        """Return whether the packet's first picture is not the second field of a frame that an earlier packet began."""
        pictures = self._pictures(packet)
        first = next(pictures, None)
        if first is None or not first[1]:
            self._open = None
            return True
        self.seen = True
        begins = not (self._open and _complementary(self._open, first))
        self._open = first if begins else None
        for picture in pictures:  # both fields may share a packet
            if self._open and _complementary(self._open, picture):
                self._open = None
        return begins

    def _pictures(self, packet: memoryview) -> Iterator[_Picture]:
        nals = behind_lengths(packet, self._length_bytes) if self._length_bytes else _behind_start_codes(packet)
        for nal in nals:
            if (kind := nal[0] & 0x1F) in (_SPS, _PPS):
                self._learn(nal)
            elif kind in (_SLICE, _IDR):
                if not any(fields for _, _, fields in self._sps.values()):
                    return
                try:
                    picture = self._picture(_Bits(nal[1:_HEADER_BYTES]))
                except (IndexError, KeyError):
                    return  # the decoder has the last word on what is damaged
                yield picture
                if not picture[1]:
                    return

    def _picture(self, bits: _Bits) -> _Picture:
        """Read a slice header (7.3.3) up to bottom_field_flag."""
        bits.ue()
        bits.ue()
        frame_num_bits, planes_apart, fields = self._sps[self._pps[bits.ue()]]
        if planes_apart:
            bits.u(2)
        frame_num = bits.u(frame_num_bits)
        structure = 1 + bits.u(1) if fields and bits.u(1) else 0
        return frame_num, structure

    def _read_configuration(self, data: memoryview) -> None:
        """Read an AVCDecoderConfigurationRecord: a count of SPS, each behind its two-byte length, then PPS alike."""
        at = 5
        for mask in (0x1F, 0xFF):
            if at >= len(data):
                return
            count, at = data[at] & mask, at + 1
            for _ in range(count):
                size = int.from_bytes(data[at : at + 2], "big")
                if size:
                    self._learn(data[at + 2 : at + 2 + size])
                at += 2 + size

    def _learn(self, nal: memoryview) -> None:
        try:
            kind, bits = nal[0] & 0x1F, _Bits(nal[1:_LARGEST_SPS_BYTES])
            if kind == _SPS:
                id, sps = _sequence_parameters(bits)
                self._sps[id] = sps
            elif kind == _PPS:
                id = bits.ue()
                self._pps[id] = bits.ue()
        except IndexError:
            return  # damaged: see _pictures


def _complementary(first: _Picture, second: _Picture) -> bool:
    """7.4.1.2.4: fields of opposite parity and the same frame_num make up a frame."""
    return {first[1], second[1]} == {1, 2} and first[0] == second[0]


def _sequence_parameters(bits: _Bits) -> tuple[int, tuple[int, bool, bool]]:
    """(id, (bits of frame_num, whether colour planes are apart, whether pictures may be fields)): 7.3.2.1.1."""
    profile = bits.u(8)
    bits.u(16)
    id, planes_apart = bits.ue(), False
    if profile in _CHROMA_PROFILES:
        chroma = bits.ue()
        planes_apart = chroma == 3 and bool(bits.u(1))
        bits.ue()
        bits.ue()
        bits.u(1)
        if bits.u(1):
            for number in range(12 if chroma == 3 else 8):
                if bits.u(1):
                    _skip_scaling_list(bits, 16 if number < 6 else 64)
    frame_num_bits = bits.ue() + 4
    order = bits.ue()
    if order == 0:
        bits.ue()
    elif order == 1:
        bits.u(1)
        bits.ue()
        bits.ue()
        for _ in range(min(bits.ue(), 255)):
            bits.ue()
    bits.ue()
    bits.u(1)
    bits.ue()
    bits.ue()
    return id, (frame_num_bits, planes_apart, not bits.u(1))


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            code = bits.ue()
            following = (last + ((code + 1) // 2 if code % 2 else -(code // 2))) % 256
        last = following or last


class _Bits:
    """Reads the bits of a NAL unit without the bytes that keep start codes out (7.4.1.1). IndexError at the end, and at
    a code that no sound stream has."""

    def __init__(self, data: memoryview) -> None:
        content = bytes(data).replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(content, "big"), 8 * len(content)

    def u(self, bits: int) -> int:
        """Return the next bits as a whole number."""
        self._left -= bits
        if self._left < 0:
            raise IndexError
        return self._value >> self._left & ((1 << bits) - 1)

    def ue(self) -> int:
        """Return the next Exp-Golomb code, 9.1."""
        zeros = 0
        while not self.u(1):
            zeros += 1
            if zeros > 32:
                raise IndexError
        return (1 << zeros) - 1 + self.u(zeros)


def behind_lengths(packet: memoryview, length_bytes: int) -> Iterator[memoryview]:
    """Yield the NAL units of a packet in which a length stands in front of each."""
    at = 0
    while at + length_bytes < len(packet):
        size = int.from_bytes(packet[at : at + length_bytes], "big")
        if size:
            yield packet[at + length_bytes : at + length_bytes + size]
        at += length_bytes + size


def _behind_start_codes(packet: memoryview) -> Iterator[memoryview]:
    """Yield each unit, from after its start code to the end of the packet; its reader finds where it ends."""
    for code in _START_CODE.finditer(packet):
        if code.end() < len(packet):
            yield packet[code.end() :]


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
_SPS_UNITS = {"h264": (0, 0x1F, 7), "hevc": (1, 0x3F, 33)}
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
        if self._codec in _SPS_UNITS:
            shift, mask, kind = _SPS_UNITS[self._codec]
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
