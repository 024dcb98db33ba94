"""What a prepared corpus costs and gives: decode speed, size and quality of codec settings, against the source.

    python -m v2v_bench.tradeoff.prepare --videos DIR --seconds 120 --json prepare.json --plot prepare.png

A job is what a sample asks of the decoder: one crop of 201 consecutive frames, file opened and sought. All settings
take turns with the source, job by job, until the time is up; a setting has the ratio of the processor time of all
jobs. Transcoding comes before that and takes as long as it takes.

The second table changes only how a file is decoded: H.264 without its loop filter, and the codecs whose standards leave
the inverse transform open, in FFmpeg's bit-exact mode. There, speed is relative to the same file decoded plainly: the
median over pairs taken side by side.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.records import write_json
from v2v_server.catalogue.files import video_files
from v2v_server.prepare.encode import CODECS, Codec, Encoding, encode_luma
from v2v_server.prepare.transcode import luma_frames
from v2v_server.video.decode import decode_luma
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import LumaFormat, copy_luma, luma_plane
from v2v_server.video.orientation import Window
from v2v_server.video.probe import probe
from v2v_server.video.rows import Rows
from v2v_server.video.source import opened, pictures

JOB_FRAMES = 201
STARTS = (0, 200)
CROP_PX = 128
MOST_FRAMES = STARTS[-1] + JOB_FRAMES
"""Frames of a clip that are transcoded; sizes are compared by the bytes of a frame."""
_GOLDEN = (math.sqrt(5) - 1) / 2
_SIDES = tuple(((6 * side, y), "left" if side > 0 else "right") for y in (0, 9, -9, 18, -18, 27) for side in (1, -1))
"""Of a point in a plot: distance in points and alignment of its name."""
_DOT_PX = 10

SOURCE = "source"
_X264 = CODECS["h264"]
_ORDINARY = replace(_X264, options=(("preset", "medium"),))
_PSYCHOVISUAL = replace(_X264, options=(("preset", "medium"), ("tune", "fastdecode")))


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to prepare the corpus."""

    name: str
    encoding: Encoding
    codec: Codec | None = None


SETTINGS = (
    *(Setting(f"h264 {q}", Encoding("h264", q, 25)) for q in (12, 16, 18, 20)),
    Setting("h264 18, GOP 12", Encoding("h264", 18, 12)),
    *(Setting(f"h264 {q}, not fastdecode", Encoding("h264", q, 25), _ORDINARY) for q in (12, 18, 20)),
    *(Setting(f"h264 18, tiles {px}", Encoding("h264", 18, 25, px)) for px in (150, 200, 300)),
    Setting("h264 18, tiles 284, overlap 128", Encoding("h264", 18, 25, 284, 128)),
    Setting("h264 18, psychovisual", Encoding("h264", 18, 25), _PSYCHOVISUAL),
    *(Setting(f"mpeg4 {q}", Encoding("mpeg4", q, 25)) for q in (2, 3)),
    Setting("mpeg4 2, GOP 12", Encoding("mpeg4", 2, 12)),
    *(Setting(f"mpeg4 {q}, tiles 200", Encoding("mpeg4", q, 25, 200)) for q in (2, 3)),
    *(Setting(f"mpeg4 {q}, tiles 284, overlap 128", Encoding("mpeg4", q, 25, 284, 128)) for q in (2, 3)),
    Setting("mpeg2 2", Encoding("mpeg2", 2, 25)),
    Setting("mjpeg 3", Encoding("mjpeg", 3, 25)),
)

_BIT_EXACT = {"flags": "+bitexact", "idct": "simpleauto"}
_SIMPLE = {"flags": "+bitexact", "idct": "simple"}
DECODERS = (
    ("loop filter skipped, non-reference", SOURCE, {"skip_loop_filter": "noref"}),
    ("loop filter skipped, all", SOURCE, {"skip_loop_filter": "all"}),
    *((f"{name}, bit-exact", name, _BIT_EXACT) for name in ("mpeg4 2", "mpeg2 2", "mjpeg 3")),
    *((f"{name}, bit-exact, C transform", name, _SIMPLE) for name in ("mpeg4 2", "mpeg2 2", "mjpeg 3")),
)
"""(name, which files, decoder options)."""


@dataclass(frozen=True, slots=True)
class File:
    """A clip in one form."""

    path: Path
    index: FrameIndex
    window: Window

    def decode(self, start: int, place: float) -> npt.NDArray[np.uint8]:
        """[201, 128, 128] uint8: one job, as a server worker does it, at ``place`` in 0 .. 1 from left to right."""
        part = self.index.slice(start, JOB_FRAMES)
        top, _, height, width = self.window
        window = (top, round(place * (self.index.width_px - width)), height, width)
        return decode_luma(self.path, part, start, JOB_FRAMES, window).frames

    def decode_with(self, options: dict[str, str]) -> npt.NDArray[np.uint8]:
        """[201, 128, 128] uint8: the first job, with options of the decoder; luma in the range it is stored in."""
        frames = np.empty((JOB_FRAMES, *self.window[2:]), np.uint8)
        with opened(self.path) as (container, stream):
            stream.codec_context.options = dict(options)
            for number, frame in enumerate(pictures(container, stream)):
                luma = LumaFormat.of(frame)
                copy_luma(luma_plane(frame, luma), luma, self.window, frames[number])
                if number + 1 == JOB_FRAMES:
                    break
        return frames


@dataclass
class Form:
    """The corpus prepared in one way."""

    files: list[File]
    bytes_per_frame: float
    psnr_db: float
    encode_seconds_per_frame: float
    seconds: list[float] = field(default_factory=list)


def sources(folder: Path, rows: Rows) -> list[tuple[File, Window]]:
    """The clips of a folder that are long and large enough, and the window that ``rows`` leaves of each.

    Raises:
        UsageError: there is none.
    """
    found = []
    for name in video_files(folder, {}):
        facts = probe(folder / name)
        top, bottom = rows.bounds(facts.height_px)
        if facts.frames < MOST_FRAMES or min(bottom - top, facts.width_px) < CROP_PX:
            continue
        window = (top, 0, bottom - top, facts.width_px)
        crop = (top + (bottom - top - CROP_PX) // 2, (facts.width_px - CROP_PX) // 2, CROP_PX, CROP_PX)
        found.append((File(folder / name, facts.index, crop), window))
    if not found:
        raise UsageError(f"{folder}: no clip of {MOST_FRAMES} frames whose rows {rows} hold a crop of {CROP_PX} px")
    return found


def prepared(clips: Sequence[tuple[File, Window]], setting: Setting, folder: Path) -> Form:
    """The clips in one form, written below ``folder``."""
    files, sizes, errors, seconds = [], [], [], 0.0
    for number, (clip, window) in enumerate(clips):
        path = folder / f"{setting.name.replace(' ', '_')}_{number}.mp4"
        frames = list(luma_frames(clip.path, clip.index.slice(0, MOST_FRAMES), window))
        begun = time.process_time()
        encode_luma(
            path, frames, setting.encoding, height=window[2], width=window[3], pts=range(MOST_FRAMES),
            time_base=Fraction(1, 25), codec=setting.codec,
        )  # fmt: skip
        seconds += time.process_time() - begun
        index = probe(path).index
        sizes.append(path.stat().st_size / MOST_FRAMES)
        errors.append(_mean_squared_error(frames, decode_luma(path, index, 0, MOST_FRAMES).frames))
        top, left, height, width = clip.window
        files.append(File(path, index, (top - window[0], left, height, width)))
    psnr = statistics.mean(_psnr_db(error) for error in errors)
    return Form(files, sum(sizes) / len(sizes), psnr, seconds / MOST_FRAMES / len(clips))


def measure(forms: dict[str, Form], seconds: float) -> list[dict[str, Any]]:
    """Decode all forms by turns for so many seconds, at least one turn; a record of each."""
    deadline = time.monotonic() + seconds
    jobs = 0
    while jobs == 0 or time.monotonic() < deadline:
        for clip in range(len(forms[SOURCE].files)):
            for start in STARTS:
                # Spread evenly however many jobs there will be, and the same for all forms.
                place = jobs * _GOLDEN % 1.0
                for form in forms.values():
                    form.seconds.append(
                        _seconds(lambda f=form, c=clip, s=start, at=place: f.files[c].decode(s, at))  # type: ignore[misc]
                    )
                jobs += 1
    source = forms[SOURCE]
    return [
        {
            "name": name,
            "kind": "prepared",
            "speed_ratio": sum(source.seconds) / sum(form.seconds),
            "seconds_per_job": statistics.mean(form.seconds),
            "size_ratio": form.bytes_per_frame / source.bytes_per_frame,
            "psnr_db": None if form is source else form.psnr_db,
            "encode_seconds_per_frame": None if form is source else form.encode_seconds_per_frame,
            "jobs": len(form.seconds),
        }
        for name, form in forms.items()
    ]


def measure_decoders(forms: dict[str, Form], seconds: float) -> list[dict[str, Any]]:
    """Decode with other options by turns with plain decoding, so many seconds; a record of each."""
    variants = [variant for variant in DECODERS if variant[1] in forms]
    times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name, _, _ in variants}
    errors: dict[str, list[float]] = {name: [] for name, _, _ in variants}
    deadline = time.monotonic() + seconds
    turns = 0
    while turns == 0 or time.monotonic() < deadline:
        for name, form, options in variants:
            for file in forms[form].files:
                if turns == 0:
                    errors[name].append(_mean_squared_error(file.decode_with({}), file.decode_with(options)))
                plain, changed = times[name]
                plain.append(_seconds(lambda f=file: f.decode_with({})))  # type: ignore[misc]
                changed.append(_seconds(lambda f=file, o=options: f.decode_with(o)))  # type: ignore[misc]
        turns += 1
    return [
        {
            "name": name,
            "kind": "decoder",
            "speed_ratio": _median_ratio(plain, changed),
            "seconds_per_job": statistics.median(changed),
            "size_ratio": None,
            "psnr_db": statistics.mean(map(_psnr_db, errors[name])) if any(errors[name]) else None,
            "identical": not any(errors[name]),
            "jobs": len(changed),
        }
        for name, (plain, changed) in times.items()
    ]


def plot(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Speed against size and against PSNR."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    colours = {"source": "black", "h264": "tab:blue", "mpeg4": "tab:orange", "mpeg2": "tab:green", "mjpeg": "tab:red"}
    figure, axes = pyplot.subplots(1, 2, figsize=(13, 5.5), sharey=True)
    shown = [record for record in records if record["kind"] == "prepared"]
    names = []
    for axis, key, label in ((axes[0], "size_ratio", "size relative to source"), (axes[1], "psnr_db", "PSNR [dB]")):
        placed = {item["name"]: (item[key], item["speed_ratio"]) for item in shown if item[key] is not None}
        for name, point in placed.items():
            colour = colours[name.split()[0]]
            axis.scatter(*point, color="none" if "not fastdecode" in name else colour, edgecolors=colour, s=45)
        names.append((axis, placed))
        axis.set_xlabel(label)
        axis.margins(x=0.25)  # room for the names
        axis.grid(alpha=0.3)
        axis.set_ylim(bottom=0)
    axes[0].set_ylabel("decode speed relative to source")
    figure.suptitle(f"One crop of {JOB_FRAMES} frames from a prepared corpus (hollow: loop filter and CABAC on)")
    figure.tight_layout()
    for axis, placed in names:
        _write_names(axis, placed)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _write_names(axis: Any, points: dict[str, tuple[float, float]]) -> None:
    """Beside each point, on the first side where there is no other name or point."""
    from matplotlib.transforms import Bbox

    renderer = axis.figure.canvas.get_renderer()
    centres = {name: axis.transData.transform(point) for name, point in points.items()}
    dots = {name: Bbox([centre - _DOT_PX / 2, centre + _DOT_PX / 2]) for name, centre in centres.items()}
    written: list[Bbox] = []
    for name, point in points.items():
        taken = written + [dot for other, dot in dots.items() if other != name]
        text = axis.annotate(name, point, textcoords="offset points", xytext=(0, 0), va="center", fontsize=7)
        for offset, side in _SIDES:
            text.set(position=offset, horizontalalignment=side)
            box = text.get_window_extent(renderer)
            if axis.bbox.x0 < box.x0 and box.x1 < axis.bbox.x1 and not any(map(box.overlaps, taken)):
                break
        written.append(box)


def _seconds(job: Callable[[], object]) -> float:
    begun = time.process_time()
    job()
    return time.process_time() - begun


def _median_ratio(slow: Sequence[float], fast: Sequence[float]) -> float:
    return statistics.median(a / b for a, b in zip(slow, fast, strict=True))


def _mean_squared_error(a: Sequence[npt.NDArray[np.uint8]] | npt.NDArray[np.uint8], b: npt.NDArray[np.uint8]) -> float:
    errors: list[float] = [cv2.norm(x, y, cv2.NORM_L2SQR) / b[0].size for x, y in zip(a, b, strict=True)]
    return sum(errors) / len(errors)


def _psnr_db(mean_squared_error: float) -> float:
    return math.inf if mean_squared_error == 0 else 10 * math.log10(255**2 / mean_squared_error)


def _print(records: Sequence[dict[str, Any]]) -> None:
    print(f"{'':36s}{'speed':>7s}{'ms/job':>8s}{'size':>7s}{'PSNR':>7s}{'encode ms/frame':>17s}")
    for record in records:
        size, psnr, encode = (record.get(key) for key in ("size_ratio", "psnr_db", "encode_seconds_per_frame"))
        quality = "same" if record.get("identical") else "" if psnr is None else f"{psnr:.1f}"
        print(
            f"{record['name']:36s}{record['speed_ratio']:7.2f}{record['seconds_per_job'] * 1e3:8.1f}"
            f"{'' if size is None else f'{size:.2f}':>7s}{quality:>7s}"
            f"{'' if encode is None else f'{encode * 1e3:.2f}':>17s}"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit status: 0, or 2 for wrong usage or input."""
    parser = argparse.ArgumentParser(
        prog="python -m v2v_bench.tradeoff.prepare", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--videos", required=True, type=Path, help="folder of clips (v2v_bench.corpus makes some)")
    parser.add_argument("--rows", default="top:0.54", help="rows to keep (default top:0.54)")
    parser.add_argument("--seconds", type=float, default=120.0, help="of measuring, in all (default 120)")
    parser.add_argument("--json", type=Path, help="write the records to this file")
    parser.add_argument("--plot", type=Path, help="draw speed against size and PSNR into this file")
    asked = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        clips = sources(asked.videos, Rows.parse(asked.rows))
        size = sum(clip.path.stat().st_size / len(clip.index) for clip, _ in clips) / len(clips)
        forms = {SOURCE: Form([clip for clip, _ in clips], size, math.inf, 0.0)}
        with tempfile.TemporaryDirectory() as folder:
            for setting in SETTINGS:
                print(f"transcoding {len(clips)} clips as {setting.name}", file=sys.stderr, flush=True)
                forms[setting.name] = prepared(clips, setting, Path(folder))
            records = measure(forms, asked.seconds * 0.7)
            decoders = measure_decoders(forms, asked.seconds * 0.3)
    except (V2VError, OSError) as error:
        print(f"v2v_bench.tradeoff.prepare: {error}", file=sys.stderr)
        return 2
    _print(records)
    print()
    _print(decoders)
    if asked.json is not None:
        write_json(asked.json, records + decoders)
    if asked.plot is not None:
        plot(records, asked.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
