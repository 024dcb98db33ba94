"""Pictures and films as files."""

from __future__ import annotations

import base64
import contextlib
import html
import io
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from PIL import Image as Pictures

from v2v_pictures import canvas
from v2v_pictures.colours import BRIGHTER, DARKER, Image
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import is_stream, write_file

_GIF_COLOURS, _GIF_COMMON, _GIF_STEP = 96, 24, 8
_GIF_EXACT = (canvas.PAPER, canvas.INK, canvas.SOFT, canvas.LINE, canvas.MARK, canvas.PAUSED_INK, BRIGHTER, DARKER)
_PNG = b"\x89PNG\r\n\x1a\n"
"""The first bytes of every PNG file."""
_QUALITY = "20"  # x264's rate factor: no visible loss of thin red and blue lines


def png_bytes(image: Image) -> bytes:
    """Encode [h, w, 3] uint8 RGB as PNG."""
    file = io.BytesIO()
    Pictures.fromarray(np.ascontiguousarray(image)).save(file, "PNG", optimize=True)
    return file.getvalue()


def gif_bytes(film: Sequence[Image], frames_per_second: float) -> bytes:
    """Encode a film as GIF, with few colours to keep it small."""
    pages = [Pictures.fromarray(np.ascontiguousarray(image)) for image in film]
    palette = _palette(np.concatenate([np.asarray(pages[at]) for at in {0, len(pages) // 2, len(pages) - 1}]))
    few = [page.quantize(palette=palette, dither=Pictures.Dither.NONE) for page in pages]
    file = io.BytesIO()
    milliseconds = round(1000 / frames_per_second)
    few[0].save(file, "GIF", save_all=True, append_images=few[1:], duration=milliseconds, loop=0, optimize=True)
    return file.getvalue()


def _palette(sampled: Image) -> Pictures.Image:
    """Return a palette picture for Pillow: exact colours for what has a meaning, a selection for photographs."""
    found, counts = np.unique(sampled.reshape(-1, 3), axis=0, return_counts=True)
    common = found[np.argsort(-counts, kind="stable")][:_GIF_COMMON]
    others = Pictures.fromarray(sampled).quantize(_GIF_COLOURS).getpalette() or []
    rest = np.concatenate([common, np.array(others, np.uint8).reshape(-1, 3)])
    exact = np.array(_GIF_EXACT, np.uint8)
    # Pillow looks colours up in steps of 4: one beside an exact colour would take its place.
    near = np.abs(rest[:, None].astype(int) - exact.astype(int)).max(axis=2).min(axis=1) < _GIF_STEP
    palette = Pictures.new("P", (1, 1))
    palette.putpalette([*exact.reshape(-1).tolist(), *rest[~near].reshape(-1).tolist()])
    return palette


def mp4_bytes(film: Sequence[Image], frames_per_second: float) -> bytes:
    """Encode a film as H.264 in MP4, which every browser plays."""
    file = io.BytesIO()
    height, width = (side // 2 * 2 for side in film[0].shape[:2])  # 4:2:0 wants even sides
    with av.open(file, "w", format="mp4") as container:
        rate = Fraction(frames_per_second).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options={"crf": _QUALITY, "preset": "medium"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for image in film:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return file.getvalue()


def html_page(title: str, sheet: Image, film: Sequence[Image], frames_per_second: float) -> str:
    """Write one HTML page that holds the sheet and the film, without other files."""
    picture = base64.b64encode(png_bytes(sheet)).decode()
    movie = base64.b64encode(mp4_bytes(film, frames_per_second)).decode() if film else ""
    video = f'<video controls loop autoplay muted src="data:video/mp4;base64,{movie}"></video>' if movie else ""
    return (
        f'<!doctype html><meta charset="utf-8"><title>{html.escape(title)}</title>'
        "<style>body{font-family:sans-serif;margin:2rem auto;max-width:1600px;padding:0 1rem;background:#fff}"
        "img,video{max-width:100%;height:auto;display:block;margin:1rem 0}</style>"
        f"{video}"
        f'<img alt="frames, event bins and flow of each virtual camera" src="data:image/png;base64,{picture}">\n'
    )


def write_png(path: Path, image: Image) -> None:
    """Write a picture as PNG, which may replace an older one, but no other file.

    Raises:
        UsageError: the name does not end in .png, a file of another kind has it, or it cannot be written.
    """
    if not is_stream(path):
        if path.suffix.lower() != ".png":
            raise UsageError(f"{path}: pictures are written as PNG; give a name that ends in .png")
        if path.is_file() and not _may_be_replaced(path):
            raise UsageError(f"{path}: the file exists and is not a PNG picture; give another name")
    write_file(path, png_bytes(image))


def _may_be_replaced(path: Path) -> bool:
    """Return whether a file is empty or a PNG picture."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(len(_PNG)) in (b"", _PNG)
    return False
