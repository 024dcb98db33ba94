"""The lossless clip store beside other ways to keep decoded luma: size against the time to read a crop.

    v2v-bench store --videos DIR --rows top:0.54 --json store.json --plot store.png

Every form keeps the same frames; a crop of each is read at places drawn at random and compared with them. Times are of
one thread's processor: the fastest reading of each place, the median over the places. ``blosc2`` takes part
where it is installed; its values are the same differences in time, which are not undone again, in its favour.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame

from bench.plots import panels
from bench.records import Column, at_least, parser_of, run, show, write
from v2v_protocol.errors import CorpusError
from v2v_server.catalogue.catalogue import open_catalogue
from v2v_server.store.format import GROUP_FRAMES, Head, group_frames_for
from v2v_server.store.packing import DENSE, FAST, QUICK, Packing
from v2v_server.store.reader import StoreFile
from v2v_server.store.writer import StoreWriter
from v2v_server.video.decode import decode_luma, stream_luma
from v2v_server.video.probe import probe
from v2v_server.video.rows import Rows

Luma = npt.NDArray[np.uint8]
Place = tuple[int, int, int]
"""First frame, row and column of a crop."""

Read = Callable[[Place], Luma]

CROP_PX = 128
CROP_FRAMES = 149
"""What the pauses of the paper's recipe leave to be decoded of 201 frames, on average."""

_MOST_FRAMES = 450
_COLUMNS: tuple[Column, ...] = (
    ("form", "", "{}", 1.0),
    ("size_ratio", "x source", "{:.2f}", 1.0),
    ("bits_per_pixel", "bits/px", "{:.2f}", 1.0),
    ("bytes_per_video_second", "MB/s of video", "{:.2f}", 1e-6),
    ("read_seconds", "read ms", "{:.2f}", 1e3),
    ("write_bytes_per_second", "write MB/s", "{:.0f}", 1e-6),
)


def _store(packing: Packing) -> Callable[[Path, Luma], Read]:
    def make(path: Path, luma: Luma) -> Read:
        count, rows, width = luma.shape
        group = group_frames_for(rows, width)
        head = Head("", "", rows, width, 0, rows, 0, count, count, 0.0, "", True, group, packing.method)
        with StoreWriter(path, head, packing) as writer:
            for picture in luma:
                writer.add(picture)
            writer.close()

        def read(place: Place) -> Luma:
            out = np.empty((CROP_FRAMES, CROP_PX, CROP_PX), np.uint8)
            with StoreFile(path) as stored:
                stored.read(place[0], 1, (*place[1:], CROP_PX, CROP_PX), out)
            return out

        return read

    return make


def _differences(luma: Luma) -> Luma:
    """In time, absolute at the first frame of each group."""
    stored = luma.copy()
    for first in range(0, len(luma), GROUP_FRAMES):
        stored[first + 1 : first + GROUP_FRAMES] -= luma[first : first + GROUP_FRAMES - 1][: len(luma) - first - 1]
    return stored


def _blosc2(codec: str, level: int) -> Callable[[Path, Luma], Read]:
    def make(path: Path, luma: Luma) -> Read:
        import blosc2

        how = {"codec": blosc2.Codec[codec], "clevel": level, "filters": [blosc2.Filter.NOFILTER], "nthreads": 1}
        shape = {"chunks": (64, 192, 192), "blocks": (GROUP_FRAMES, 32, 32)}
        blosc2.asarray(_differences(luma), **shape, cparams=how, urlpath=str(path), mode="w")
        return lambda place: _cut(blosc2.open(str(path), mode="r", dparams={"nthreads": 1}), place)

    return make


def _ffv1(path: Path, luma: Luma) -> Read:
    rows, width = luma.shape[1:]
    with av.open(str(path), "w", format="matroska") as output:
        stream = output.add_stream("ffv1", rate=25, options={"g": "32"})
        stream.width, stream.height, stream.pix_fmt, stream.thread_count = width, rows, "gray", 1
        for number, picture in enumerate(luma):
            frame = VideoFrame.from_ndarray(picture, format="gray")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    index = probe(path).index
    return lambda place: decode_luma(path, index, place[0], CROP_FRAMES, (*place[1:], CROP_PX, CROP_PX)).frames


def _cut(array: Any, place: Place) -> Luma:
    frame, row, column = place
    taken: Luma = array[frame : frame + CROP_FRAMES, row : row + CROP_PX, column : column + CROP_PX]
    return taken


def forms() -> dict[str, tuple[Callable[[Path, Luma], Read], bool]]:
    """By name: what makes a form of some luma, and whether it gives back the luma itself."""
    found: dict[str, tuple[Callable[[Path, Luma], Read], bool]] = {
        "store dense": (_store(DENSE), True),
        "store fast": (_store(FAST), True),
        "cache": (_store(QUICK), True),
    }
    if find_spec("blosc2"):
        found |= {f"blosc2 {codec} {level}": (_blosc2(codec, level), False)
                  for codec, level in (("ZSTD", 1), ("ZSTD", 5), ("LZ4HC", 9))}  # fmt: skip
    return found | {"FFV1": (_ffv1, True)}


def measure(videos: Path, rows: str, most: int, places: int, seconds: float) -> Iterator[dict[str, Any]]:
    """A record of each form of each of the first clips that are long and large enough.

    Raises:
        CorpusError: no clip is.
    """
    catalogue = open_catalogue(videos, rows=Rows.parse(rows), processes=0)
    try:
        used = 0
        for video in catalogue.videos:
            top, bottom = catalogue.rows.bounds(video.height_px)
            if video.frames < CROP_FRAMES or bottom - top < CROP_PX or video.width_px < CROP_PX or used == most:
                continue
            used += 1
            window = (top, 0, bottom - top, video.width_px)
            path, index, count = (
                catalogue.path(video.id),
                catalogue.frame_index(video.id),
                min(video.frames, _MOST_FRAMES),
            )
            luma = np.stack(list(stream_luma(path, index, 0, count, window)))
            share = path.stat().st_size * count / video.frames
            random = np.random.default_rng(0)
            limits = np.array(luma.shape) - np.array([CROP_FRAMES, CROP_PX, CROP_PX]) + 1
            drawn = [tuple(map(int, random.integers(0, limits))) for _ in range(places)]
            for name, (make, is_luma) in forms().items():
                yield {
                    "video": video.id, "form": name, "source_bytes": share, "pixels": luma.size,
                    "seconds": count / video.frames_per_second, **_measured(make, is_luma, luma, drawn, seconds),
                }  # fmt: skip
            decode = partial(decode_luma, path, index)
            whole = [partial(decode, at[0], CROP_FRAMES, (top + at[1], at[2], CROP_PX, CROP_PX)) for at in drawn]
            yield {
                "video": video.id, "form": "source", "source_bytes": share, "pixels": luma.size,
                "seconds": count / video.frames_per_second, "bytes": share, "read_seconds": _timed(whole, seconds),
                "write_bytes_per_second": float("nan"),
            }  # fmt: skip
        if not used:
            raise CorpusError(f"--videos {videos}: no clip of {CROP_FRAMES} frames and {CROP_PX} x {CROP_PX} px")
    finally:
        catalogue.close()


def _measured(
    make: Callable[[Path, Luma], Read], is_luma: bool, luma: Luma, places: list[Any], seconds: float
) -> dict[str, float]:
    folder = Path(tempfile.mkdtemp(prefix="v2v-bench-store-"))
    try:
        started = time.process_time()
        read = make(folder / "form", luma)
        writing = time.process_time() - started
        wanted = luma if is_luma else _differences(luma)
        for place in places:
            np.testing.assert_array_equal(read(place), _cut(wanted, place))
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        taken = _timed([partial(read, place) for place in places], seconds)
    finally:
        shutil.rmtree(folder)
    return {
        "bytes": size,
        "read_seconds": taken,
        "write_bytes_per_second": luma.size / writing,
    }


def _timed(calls: Sequence[Callable[[], object]], seconds: float) -> float:
    """Processor time of a call: the fastest of each, the median over them."""
    fastest = [float("inf")] * len(calls)
    end = time.perf_counter() + seconds
    while fastest[-1] == float("inf") or time.perf_counter() < end:
        for number, call in enumerate(calls):
            started = time.process_time()
            call()
            fastest[number] = min(fastest[number], time.process_time() - started)
    return statistics.median(fastest)


def summary(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A record of each form: medians over the clips."""
    found = []
    for form in dict.fromkeys(record["form"] for record in records):
        of = [record for record in records if record["form"] == form]

        def median(value: Callable[[dict[str, Any]], float], of: list[dict[str, Any]] = of) -> float:
            return statistics.median(map(value, of))

        found.append({
            "form": form,
            "size_ratio": median(lambda record: record["bytes"] / record["source_bytes"]),
            "bits_per_pixel": median(lambda record: 8 * record["bytes"] / record["pixels"]),
            "bytes_per_video_second": median(lambda record: record["bytes"] / record["seconds"]),
            "read_seconds": median(lambda record: record["read_seconds"]),
            "write_bytes_per_second": median(lambda record: record["write_bytes_per_second"]),
        })  # fmt: skip
    return found


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, clips=1, places=1)
    records = []
    for record in measure(asked.videos, asked.rows, asked.clips, asked.places, asked.seconds):
        records.append(record)
        print(f"{record['video']}: {record['form']}", file=sys.stderr, flush=True)
    medians = summary(records)
    show(medians, _COLUMNS)
    write([*records, *medians], asked.json)
    if asked.plot is not None:
        with panels(asked.plot, 1, title="Forms of a store: time to read, and size") as (axes,):
            for record in medians:
                axes.scatter(record["size_ratio"], 1e3 * record["read_seconds"])
                axes.annotate(record["form"], (record["size_ratio"], 1e3 * record["read_seconds"]))
            axes.set(xlabel="size, multiple of the source", ylabel="ms to read a crop", yscale="log")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = parser_of(__doc__, "store", seconds=2.0, what="reading crops of each form of each clip")
    parser.add_argument("--videos", required=True, type=Path, help="clips (bench.corpus)")
    parser.add_argument("--rows", default="top:0.54", help="of --videos")
    parser.add_argument("--clips", type=int, default=6, help="at most so many")
    parser.add_argument("--places", type=int, default=8, help="crops read of each")
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
