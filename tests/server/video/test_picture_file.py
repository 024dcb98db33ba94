"""Single pictures: what FFmpeg does not decode is Pillow's, and what is damaged is found by a second reader."""

from __future__ import annotations

import gc
import os
import zlib
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest
import xxhash
from av.packet import Packet
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from tests.server.picture_files import chunk, encoded, png_of_ffmpeg, png_parts, shortened, tiff
from v2v_protocol.errors import VideoError
from v2v_server.store.photograph import Photograph
from v2v_server.store.picture_sequence import PictureSequence
from v2v_server.system.isolate import run_isolated
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.picture_file import check_picture, check_rows, decode_picture, read_head
from v2v_server.video.probe import probe

HEIGHT, WIDTH = 150, 200
Y, X = np.mgrid[:HEIGHT, :WIDTH]
GREY = (110 + 60 * np.sin(X / 6) + 30 * np.cos(Y / 5)).astype(np.uint8)
RGB = np.dstack([GREY, np.roll(GREY, 9, 1), np.roll(GREY, 5, 0)])
PIXELS: dict[str, npt.NDArray[Any]] = {
    "grey": GREY, "grey16": GREY.astype(np.uint16) * 257, "rgb": RGB, "rgba": np.dstack([RGB, 255 - GREY]),
    "rgb16": RGB.astype(np.uint16) * 257,
}  # fmt: skip


def grey_of(data: bytes) -> npt.NDArray[np.int16]:
    """Return the upright grey levels of a picture after its check, 8 bits."""
    head = read_head(data)
    check_picture(data, head)
    frame, _ = decode_picture(data)
    levels = frame.reformat(format="gray").to_ndarray().astype(np.int16)
    upright: npt.NDArray[np.int16] = head.orientation_of(frame).upright(levels[None])[0]
    return upright


def why_refused(tmp_path: Path, data: bytes, suffix: str) -> set[str]:
    """Return why a file is refused as a photograph and as a sequence; "" if it is not."""
    (tmp_path / f"1.{suffix}").write_bytes(data)
    reasons = set[str]()
    for pixels in PictureSequence(tmp_path), Photograph(tmp_path / f"1.{suffix}"):
        try:
            pixels.facts()
            reasons.add("")
        except VideoError as error:
            reasons.add(error.reason.removeprefix(f"1.{suffix}: "))
    return reasons


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("tile", [0, 64])
@pytest.mark.parametrize("kind", PIXELS)
def test_tiff_in_strips_and_tiles_is_the_same_picture_or_refused(
    tmp_path: Path, kind: str, tile: int, big: bool
) -> None:
    data, expected = tiff(PIXELS[kind], tile, big), grey_of(encoded(GREY if "grey" in kind else RGB, "png"))
    if kind == "rgb16" and (tile or big):  # Pillow would cut it to 8 bits
        (why,) = why_refused(tmp_path, data, "tif")
        assert why.startswith("has RGB pixels in a TIFF file in tiles")
    else:
        assert why_refused(tmp_path, data, "tif") == {""}
        assert abs(grey_of(data) - expected).max() <= 2 * (kind == "rgb16")


LOSSLESS = "raw", "tiff_lzw", "tiff_deflate", "tiff_adobe_deflate", "packbits", "zstd", "lzma"
COMPRESSED = [
    *((mode, compression) for mode in ("1", "L", "RGB", "P", "LA", "RGBA", "I;16") for compression in LOSSLESS),
    ("L", "jpeg"), ("RGB", "jpeg"), ("1", "group3"), ("1", "group4"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "compression"), COMPRESSED)
def test_every_compression_of_tiff_is_read(kind: str, compression: str) -> None:
    picture = Image.fromarray(PIXELS["grey16"]) if kind == "I;16" else Image.fromarray(RGB).convert(kind)
    data = encoded(picture, "tiff", compression=compression)
    shown = picture if kind in ("I;16", "1") else picture.convert("RGB")
    expected = grey_of(encoded(shown, "png"))
    assert abs(grey_of(data) - expected).max() <= (24 if compression == "jpeg" else 1)
    assert decode_picture(data)[1] == ("mjpeg" if compression == "jpeg" else "tiff")


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"t262": 0}, "has I;16 pixels"),  # white is zero, which Pillow leaves
        ({"t259": 7}, "damaged"),  # not the JPEG that it is called
    ],
)
def test_tiles_that_pillow_reads_wrong_are_refused(tmp_path: Path, changed: dict[str, int], why: str) -> None:
    (found,) = why_refused(tmp_path, tiff(PIXELS["grey16"], 64, **changed), "tif")
    assert why in found


@pytest.mark.parametrize("tile", [0, 64])
@pytest.mark.parametrize("kind", ["grey", "grey16"])
def test_signed_and_real_numbers_of_tiff_are_refused(kind: str, tile: int) -> None:
    """Decoders take signed numbers for levels from 0 on, which turns dark into bright."""
    assert abs(grey_of(tiff(PIXELS[kind], tile, t339=1)) - GREY).max() <= 1
    for data in tiff(PIXELS[kind], tile, t339=2), encoded(PIXELS[kind].astype(np.float32), "tiff"):
        with pytest.raises(ValueError, match=r"sample format [23], .*: write levels from 0 on"):
            decode_picture(data)


def test_tiff_that_ffmpeg_reads_alone_is_kept(tmp_path: Path) -> None:
    """Pillow leaves these levels as they are stored, and FFmpeg does not."""
    inverse = tiff(65535 - PIXELS["grey16"], t262=0)
    assert why_refused(tmp_path, inverse, "tif") == {""}
    assert abs(grey_of(inverse) - GREY).max() <= 1


@given(
    st.sampled_from(("gray", "gray16be", "rgb24", "rgb48be", "rgba", "ya8", "monob")),
    st.booleans(),
    st.integers(1, 20),
    st.integers(1, 20),
)
def test_rows_of_png_are_complete_or_missed(pixel_format: str, interlaced: bool, height: int, width: int) -> None:
    data = png_of_ffmpeg(pixel_format, interlaced, height, width)
    assert data[28] == interlaced
    check_rows(data)
    check_rows(shortened(data, lambda length: length))
    with pytest.raises(ValueError, match="is truncated or damaged: it has"):
        check_rows(shortened(data, lambda length: length - 1))


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("pixel_format", ["gray", "gray16be", "rgb24", "pal8", "monob"])
def test_png_with_too_few_rows_is_refused(tmp_path: Path, pixel_format: str, interlaced: bool) -> None:
    data = png_of_ffmpeg("rgb24" if pixel_format == "pal8" else pixel_format, interlaced, HEIGHT, WIDTH)
    if pixel_format == "pal8":
        data = encoded(Image.fromarray(RGB).quantize(200), "png")
    assert why_refused(tmp_path, data, "png") == {""}
    for share in (0.999, 0.34, 0.0):
        (why,) = why_refused(tmp_path, shortened(data, lambda length, kept=share: int(length * kept)), "png")
        assert "bytes of its rows" in why


@pytest.mark.parametrize("interlaced", [False, True])
def test_png_with_an_unknown_filter_is_refused(interlaced: bool) -> None:
    """FFmpeg takes it for another filter, and the rows below are wrong."""
    data = png_of_ffmpeg("gray", interlaced, HEIGHT, WIDTH)
    rows = bytearray(zlib.decompress(b"".join(content for kind, content in png_parts(data) if kind == b"IDAT")))
    rows[-WIDTH - 1] = 9  # of the last row, also of the last pass
    parts = [(b"IHDR", png_parts(data)[0][1]), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    with pytest.raises(ValueError, match="is damaged: a row has the filter 9, and PNG has 0 to 4"):
        check_rows(data[:8] + b"".join(chunk(*part) for part in parts))


def test_damaged_webp_is_refused() -> None:
    """Lossless data has no redundancy: much of its damage is not seen."""
    sound = encoded(RGB, "webp", quality=90)
    check_picture(sound, read_head(sound))
    for seed in range(20):
        random, damaged = np.random.default_rng(seed), bytearray(sound)
        at = int(random.integers(100, len(sound) - 60))
        damaged[at : at + 4] = random.bytes(4)
        decode_picture(bytes(damaged))  # without a word
        with pytest.raises(OSError, match=r"."):
            check_picture(bytes(damaged), read_head(sound))


@pytest.mark.parametrize("form", ["tiff", "bmp", "webp", "jpeg", "png"])
def test_cut_pictures_are_refused(tmp_path: Path, form: str) -> None:
    options = {"compression": "tiff_lzw"} if form == "tiff" else {}
    data = encoded(RGB, form, **options)
    for length in (len(data) // 3, len(data) * 2 // 3, len(data) - 30):
        assert "" not in why_refused(tmp_path, data[:length], form)


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_deflate", "tiff_adobe_deflate", "packbits", "jpeg"])
def test_damaged_tiff_is_refused_or_differs_in_few_pixels(compression: str) -> None:
    """FFmpeg alone leaves the rest of a strip black."""
    data, random, refused = encoded(RGB, "tiff", compression=compression), np.random.default_rng(2), 0
    expected = grey_of(data)
    for _ in range(12):
        damaged, at = bytearray(data), int(random.integers(len(data) // 8, len(data) * 3 // 4))
        damaged[at : at + 40] = random.bytes(40)
        try:
            share = float((abs(grey_of(bytes(damaged)) - expected) > 8).mean())
        except (ValueError, OSError, zlib.error):
            refused += 1
        else:
            assert share < 0.01
    assert refused >= 6


def photograph(seed: int | None = None) -> bytes:
    """Return a JPEG photograph, of which some bytes are overwritten with a seed."""
    y, x = np.mgrid[:240, :320]
    noise = np.random.default_rng(0).normal(0, 6, (240, 320, 3))
    pixels = np.stack([40 + 0.5 * x, 60 + 0.6 * y, 128 + 60 * np.sin(x / 9) * np.cos(y / 13)], -1) + noise
    data = bytearray(encoded(pixels.clip(0, 255).astype(np.uint8), "jpeg", quality=92))
    if seed is not None:
        random = np.random.default_rng(seed)
        at = int(random.integers(data.index(b"\xff\xda") + 200, len(data) - 600))
        count = int(random.choice([1, 4, 40, 512]))
        data[at : at + count] = random.integers(0, 255, count).astype(np.uint8).tobytes()
    return bytes(data)


def test_most_damaged_jpegs_are_refused() -> None:
    """Of 60, FFmpeg decodes 14 visibly wrong; libjpeg warns of 12 of them."""
    expected, served = grey_of(photograph()), []
    for seed in range(60):
        data = photograph(seed)
        try:
            share = float((abs(grey_of(data) - expected) > 8).mean())
        except ValueError:
            continue
        served += [seed] * (share > 0.01)
    assert len(served) <= 2, served


def restarts(data: bytes) -> list[int]:
    return [at for at in range(len(data) - 1) if data[at] == 0xFF and 0xD0 <= data[at + 1] <= 0xD7]


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_jpegs_with_wrong_restarts_or_without_an_end_are_refused(tmp_path: Path, mode: str, progressive: bool) -> None:
    picture = Image.fromarray(RGB).convert(mode)
    data = encoded(picture, "jpeg", progressive=progressive, restart_marker_rows=1)
    fifth, sixth = restarts(data)[5:7]
    wrong = data[: fifth + 1] + b"\xd0" + data[fifth + 2 :]
    for damaged in (
        wrong,
        data[:fifth] + data[sixth:],
        data[: fifth + 9] + data[sixth:],
        data[: len(data) // 2],
        data[:-2],
    ):
        (why,) = why_refused(tmp_path, damaged, "jpg")
        assert why.startswith("is truncated or damaged: libjpeg says '")


def sound_jpegs() -> list[bytes]:
    """Return JPEG pictures as several encoders write them, with what cameras and editors put around them."""
    import cv2

    found = []
    for quality in (10, 75, 100):
        for options in ({}, {"progressive": True}, {"restart_marker_blocks": 3}, {"optimize": True}):
            found += [encoded(RGB, "jpeg", quality=quality, subsampling=each, **options) for each in (0, 1, 2)]
        for flag in (0, cv2.IMWRITE_JPEG_PROGRESSIVE, cv2.IMWRITE_JPEG_RST_INTERVAL):
            flags = [cv2.IMWRITE_JPEG_QUALITY, quality, *([flag, 1] if flag else [])]
            found.append(cv2.imencode(".jpg", RGB[:101, :77], flags)[1].tobytes())
        found.append(encoded(GREY, "jpeg", quality=quality))
    for pixel_format in ("yuvj420p", "yuvj422p", "yuvj444p"):
        encoder: Any = av.CodecContext.create("mjpeg", "w")
        encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = WIDTH, HEIGHT, pixel_format, Fraction(1)
        frame = av.VideoFrame.from_ndarray(RGB, format="rgb24").reformat(format=pixel_format)
        found.append(b"".join(map(bytes, [*encoder.encode(frame), *encoder.encode(None)])))
    plain = found[0]
    table = plain.index(b"\xff\xdb")
    found += [plain + bytes(5000), plain + plain, plain[:table] + b"odd" + plain[table:]]
    found.append(encoded(RGB, "jpeg", exif=b"Exif\0\0broken", comment=b"\xff\xd9"))
    return found


def test_sound_jpegs_are_served() -> None:
    for data in sound_jpegs():
        assert grey_of(data).max() > 150


def test_standard_error_is_as_before(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="libjpeg"):
        check_picture(photograph(23), read_head(photograph(23)))
    os.write(2, b"shown")
    assert capfd.readouterr().err == "shown"


TURNED = {
    1: lambda upright: upright, 2: lambda upright: upright[:, ::-1], 3: lambda upright: upright[::-1, ::-1],
    4: lambda upright: upright[::-1], 5: lambda upright: upright.T, 6: lambda upright: np.rot90(upright),
    7: lambda upright: upright[::-1, ::-1].T, 8: lambda upright: np.rot90(upright, -1),
}  # fmt: skip
"""What is stored of an upright picture, by its Exif orientation."""


@pytest.mark.parametrize(
    ("form", "turned"),
    [
        *((form, turned) for form in ("jpeg", "png", "tiff", "webp", "tiles") for turned in TURNED),
        *(("late", turned) for turned in (1, 3, 6, 8)),
    ],
)
def test_every_orientation_is_applied_alike(tmp_path: Path, form: str, turned: int) -> None:
    stored, exif = np.ascontiguousarray(TURNED[turned](GREY)), Image.Exif()
    exif[0x0112] = turned
    if form == "tiles":
        data = tiff(stored, 64, t274=turned)
    elif form == "late":  # behind the picture, where only FFmpeg looks, and tells the angle
        parts = png_parts(encoded(stored, "png", exif=exif))
        parts.insert(-1, parts.pop([kind for kind, _ in parts].index(b"eXIf")))
        data = b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)
    else:
        options = {"quality": 100} if form == "jpeg" else {"lossless": True} if form == "webp" else {}
        data = encoded(stored, form, **(options | ({"tiffinfo": {274: turned}} if form == "tiff" else {"exif": exif})))
    suffix = {"tiles": "tiff", "late": "png"}.get(form, form)
    path = tmp_path / f"1.{suffix}"
    path.write_bytes(data)
    for pixels in PictureSequence(tmp_path), Photograph(path):
        (clip,) = pixels.clips(ClipRequest(pixels.facts().index, 0, (Cut(1),)))
        assert clip.frames[0].shape == GREY.shape
        assert abs(clip.frames[0].astype(int) - GREY).max() <= (3 if form == "jpeg" else 0)


def test_further_pictures_of_a_file_are_said(tmp_path: Path) -> None:
    others = [Image.fromarray(GREY[::-1])]
    (tmp_path / "1.tif").write_bytes(encoded(GREY, "tiff", save_all=True, append_images=others))
    facts = PictureSequence(tmp_path).facts()
    assert (facts.frames, facts.remark) == (1, "its other pictures are left out")


def test_an_orientation_that_ffmpeg_does_not_know_has_another_name(tmp_path: Path) -> None:
    """Releases before applied FFmpeg's; equal names are equal frames."""
    names = {}
    for turned in (1, 4, 6):
        exif = Image.Exif()
        exif[0x0112] = turned
        data = encoded(GREY, "jpeg", exif=exif)
        (tmp_path / "1.jpg").write_bytes(data)
        names[turned] = PictureSequence(tmp_path).facts().content == xxhash.xxh3_128(data).hexdigest()
    assert names == {1: True, 4: False, 6: True}


def png_with_profile(number: int) -> bytes:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return encoded(np.full((16, 16, 3), number % 200, np.uint8), "png", icc_profile=profile)


def count_frames(path: str) -> int:
    """Probe a video or sequence, and free all that was read of it."""
    frames = (PictureSequence(path).facts() if Path(path).is_dir() else probe(path)).frames
    gc.collect()
    return frames


def test_colour_profiles_do_not_end_the_process(tmp_path: Path) -> None:
    """PyAV frees the name of a profile that FFmpeg frees too, when Python collects garbage."""
    (tmp_path / "seq").mkdir()
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        stream: Any = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = 16, 16, "rgb24"
        for number in range(400):
            data = png_with_profile(number)
            (tmp_path / f"seq/{number:03}.png").write_bytes(data)
            packet: Any = Packet(data)
            packet.stream, packet.pts, packet.dts, packet.time_base = stream, number, number, Fraction(1, 25)
            packet.is_keyframe = True
            container.mux(packet)
    jobs = [str(tmp_path / "seq"), str(tmp_path / "a.mov")]
    assert dict(run_isolated(count_frames, jobs, 1)) == dict.fromkeys(jobs, 400)
