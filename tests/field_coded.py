"""Write H.264 whose pictures are stored as two fields, as AVCHD cameras do; no encoder available to tests does.

Every macroblock is stored uncompressed (I_PCM), so that decoding gives exactly the input pictures. Clauses are those of
ITU-T H.264. Display order I b P b P ...; every third picture is stored as a whole frame, because streams mix both.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

_IDR, _SLICE, _SPS, _PPS = 5, 1, 7, 8
_I, _P, _B = 7, 5, 6
_PCM = {_I: 25, _P: 30, _B: 48}
_TICKS = 3600  # of 90 kHz, a frame at 25 Hz


class _Bits:
    def __init__(self) -> None:
        self.text: list[str] = []

    def u(self, value: int, bits: int) -> None:
        self.text.append(f"{value:0{bits}b}")

    def ue(self, *values: int) -> None:
        """Exp-Golomb codes (9.1)."""
        for value in values:
            code = f"{value + 1:b}"
            self.text.append("0" * (len(code) - 1) + code)

    def align(self) -> None:
        self.text.append("0" * (-len("".join(self.text)) % 8))

    def bytes(self) -> bytes:
        text = "".join(self.text)
        return int(text, 2).to_bytes(len(text) // 8, "big")

    def nal(self, kind: int, reference: int) -> bytes:
        """With trailing bits (7.3.2.11), and emulation of start codes prevented (7.4.1)."""
        self.u(1, 1)
        self.align()
        out, zeros = bytearray(), 0
        for byte in self.bytes():
            if zeros > 1 and byte < 4:
                out.append(3)
                zeros = 0
            out.append(byte)
            zeros = 0 if byte else zeros + 1
        return b"\0\0\0\1" + bytes([reference << 5 | kind]) + bytes(out)


def _parameters(height: int, width: int) -> bytes:
    """7.3.2.1.1 and 7.3.2.2."""
    sps = _Bits()
    for value in (77, 0, 40):  # profile, constraints, level
        sps.u(value, 8)
    sps.ue(0, 0, 0, 4, 2)  # id, log2_max_frame_num - 4, POC type 0, log2_max_poc_lsb - 4, reference frames
    sps.u(0, 1)
    sps.ue(width // 16 - 1, height // 32 - 1)
    sps.text.append("00100")  # frame_mbs_only 0, no MBAFF, direct_8x8_inference, neither cropping nor VUI
    pps = _Bits()
    pps.ue(0, 0)
    pps.text.append("00")
    pps.ue(0, 0, 0)
    pps.text.append("000")
    pps.ue(0, 0, 0)
    pps.text.append("100")  # deblocking control
    return sps.nal(_SPS, 3) + pps.nal(_PPS, 3)


def _picture(luma: npt.NDArray[np.uint8], kind: int, idr: bool, frame_num: int, order: int, field: int | None) -> bytes:
    """One slice (7.3.3) that holds a frame, or the field 0 (top) or 1 (bottom)."""
    out = _Bits()
    out.ue(0, kind, 0)
    out.u(frame_num % 16, 4)
    out.text.append("0" if field is None else f"1{field}")
    if idr:
        out.ue(0)
    out.u(order % 256, 8)
    out.text.append({_I: "", _P: "00", _B: "1000"}[kind])
    if kind != _B:
        out.text.append("00" if idr else "0")
    out.ue(0, 1)  # no change of QP; no deblocking
    for top in range(0, luma.shape[0], 16):
        for left in range(0, luma.shape[1], 16):
            if kind != _I:
                out.ue(0)
            out.ue(_PCM[kind])
            out.align()
            block = luma[top : top + 16, left : left + 16].tobytes() + bytes([128]) * 128
            out.text.append(f"{int.from_bytes(block, 'big'):0{8 * len(block)}b}")
    return out.nal(_IDR if idr else _SLICE, 0 if kind == _B else 2)


def write_field_coded(path: Path, luma: npt.NDArray[np.uint8], *, gop: int = 6, together: bool = False) -> Path:
    """Stores a clip at 25 Hz.

    Args:
        path: its suffix chooses the container.
        luma: [frames, height, width] uint8, sides multiples of 32 and 16 px.
        gop: frames from an IDR picture to the next; even.
        together: both fields in one packet, as Matroska wants it.
    """
    count, height, width = luma.shape
    packets: list[tuple[bytes, int, int, bool]] = []  # content, pts, dts, keyframe
    for first in range(0, count, gop):
        shown = range(min(gop, count - first))
        # A b-picture follows the reference that it precedes on display; one at the end has none and becomes that.
        order = [0] + [k for p in shown[2::2] for k in (p, p - 1)]
        order += [shown[-1]] if len(shown) > 1 and len(shown) % 2 == 0 else []
        references = 0
        for k in order:
            is_b = k % 2 == 1 and k + 1 in shown
            kind = _I if k == 0 else _B if is_b else _P
            number = references
            references += not is_b
            frame, pts = luma[first + k], (first + k + 2) * _TICKS
            dts = (first + order.index(k)) * _TICKS
            head = _parameters(height, width) if k == 0 else b""
            if (first + k) % 3 == 2:
                packets.append((head + _picture(frame, kind, k == 0, number, 2 * k, None), pts, dts, k == 0))
                continue
            top = head + _picture(frame[0::2], kind, k == 0, number, 2 * k, 0)
            bottom = _picture(frame[1::2], kind, False, number, 2 * k + 1, 1)
            if together:
                packets.append((top + bottom, pts, dts, k == 0))
            else:
                packets.append((top, pts, dts, k == 0))
                packets.append((bottom, pts + _TICKS // 2, dts + _TICKS // 2, False))
    raw = path.with_name(f"{path.name}.h264")
    raw.write_bytes(b"".join(content for content, *_ in packets))
    if path.suffix == ".h264":
        return raw.rename(path)
    with av.open(str(raw)) as source, av.open(str(path), "w") as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        for content, pts, dts, keyframe in packets:
            packet = av.Packet(content)
            packet.pts, packet.dts, packet.time_base = pts, dts, Fraction(1, 90000)
            packet.is_keyframe, packet.stream = keyframe, stream
            packet.duration = _TICKS  # without one an mp4 file ends before its last picture
            output.mux(packet)
    raw.unlink()
    return path
