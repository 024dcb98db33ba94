"""Measure the lossless clip store: its size, and the time to read a crop, beside the source.

    python -m bench store --videos DIR --rows top:0.54 --json store.json

Each form keeps the same frames. Crops of 149 frames of 128 x 128 pixels, which is what a sample of the paper's recipe
decodes on average, are read at random places and compared with the frames. Times are processor times of one thread:
the fastest reading of each place, the median over the places, the median over the clips.

Then the clips are prepared with and without scene statistics in turns, the fastest of three.

Bar: over all clips, the statistics add at most 15 % of processor time.
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_videos, add_whole, medians, progress
from tests.oracles.decoded import decode_luma, stream_luma
from v2v_protocol.command import Parser
from v2v_protocol.errors import CorpusError
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.prepare import Transcoding, transcode
from v2v_server.store.format import DEFAULT_SIZE, DENSE, FAST, QUICK, RAW, Head, Packing, group_frames_for
from v2v_server.store.store_file import StoreFile, StoreWriter
from v2v_server.video.rows import Rows

Luma = npt.NDArray[np.uint8]
CROP = (149, 128, 128)  # Frames, rows and columns
FORMS = {"store dense": DENSE, "store fast": FAST, "store raw": RAW, "cache": QUICK}
MOST_ADDED = 0.15
_MOST_FRAMES = 450
_TURNS, _READS, _PLACES = 3, 10, 8
_COLUMNS: tuple[Column, ...] = (
    ("form", "", "{}", 1.0),
    ("ratio_to_source_bytes", "x source", "{:.2f}", 1.0),
    ("bits_per_pixel", "bits/px", "{:.2f}", 1.0),
    ("bytes_per_video_second", "MB/s of video", "{:.2f}", 1e-6),
    ("read_cpu_seconds", "read ms", "{:.2f}", 1e3),
    ("write_bytes_per_cpu_second", "write MB/s", "{:.0f}", 1e-6),
)
_PREPARED: tuple[Column, ...] = (
    ("video", "prepared", "{}", 1.0),
    ("frames", "frames", "{}", 1.0),
    ("prepare_cpu_seconds", "cpu s", "{:.2f}", 1.0),
    ("prepare_scene_cpu_seconds", "with scene", "{:.2f}", 1.0),
    ("added_share", "added", "{:.1%}", 1.0),
)


def write_store(path: Path, luma: Luma, packing: Packing) -> None:
    """Write [n, rows, columns] luma as a store."""
    count, rows, width = luma.shape
    group = group_frames_for(rows, width)
    head = Head("", "", rows, width, 0, rows, 0, count, count, 0.0, "", True, group, packing.method)
    with StoreWriter(path, head, packing) as writer:
        for picture in luma:
            writer.add(picture)
        writer.close()


def read_crop(path: Path, place: Sequence[int]) -> Luma:
    """Read one crop of a store from its first frame, row and column."""
    out = np.empty(CROP, np.uint8)
    with StoreFile(path) as stored:
        stored.read(place[0], 1, (place[1], place[2], *CROP[1:]), out)
    return out


def fastest_seconds(calls: Sequence[Callable[[], object]]) -> float:
    """Return the fastest processor time of each call, the median over them."""
    return statistics.median(
        min(timeit.repeat(call, timer=time.process_time, number=1, repeat=_READS)) for call in calls
    )


def clips(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield one record for each form of the first clips that are long and large enough."""
    with (
        closing(open_catalogue(asked.videos, rows=Rows.parse(asked.rows), processes=0)) as catalogue,
        tempfile.TemporaryDirectory(prefix="v2v-store-") as folder,
    ):
        used = 0
        for video in catalogue.videos:
            top, bottom = catalogue.rows.bounds(video.height_px)
            if used == asked.clips or np.less((video.frames, bottom - top, video.width_px), CROP).any():
                continue
            used += 1
            path, index = catalogue.path(video.id), catalogue.frame_index(video.id)
            count = min(video.frames, _MOST_FRAMES)
            luma = np.stack(list(stream_luma(path, index, 0, count, (top, 0, bottom - top, video.width_px))))
            source_bytes = path.stat().st_size * count / video.frames
            places = np.random.default_rng(0).integers(0, np.subtract(luma.shape, CROP) + 1, (_PLACES, 3)).tolist()
            reads = [
                partial(decode_luma, path, index, at[0], CROP[0], (top + at[1], at[2], *CROP[1:])) for at in places
            ]
            common = {
                "video": video.id, "pixels": luma.size, "source_bytes": source_bytes,
                "seconds": count / video.frames_per_second,
            }  # fmt: skip
            yield common | {
                "form": "source",
                "bytes": source_bytes,
                "read_cpu_seconds": fastest_seconds(reads),
            }
            for form, packing in FORMS.items():
                progress(f"{video.id}: {form}")
                file = Path(folder, f"{used}-{form}")
                started = time.process_time()
                write_store(file, luma, packing)
                writing = time.process_time() - started
                for at in places:
                    wanted = luma[tuple(slice(first, first + size) for first, size in zip(at, CROP, strict=True))]
                    np.testing.assert_array_equal(read_crop(file, at), wanted)
                yield common | {
                    "form": form,
                    "bytes": file.stat().st_size,
                    "read_cpu_seconds": fastest_seconds([partial(read_crop, file, at) for at in places]),
                    "write_bytes_per_cpu_second": luma.size / writing,
                }


def prepared(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the processor time of preparing each of the first videos, without and with scene statistics."""
    with (
        closing(open_catalogue(asked.videos, rows=Rows.parse(asked.rows), processes=0)) as catalogue,
        tempfile.TemporaryDirectory(prefix="v2v-store-") as folder,
    ):
        root = Path(folder).resolve()
        for video in islice(catalogue.videos, asked.clips):
            progress(f"{video.id}: prepare")
            top, bottom = catalogue.rows.bounds(video.height_px)
            index = catalogue.frame_index(video.id).to_bytes()
            job = Transcoding(
                video, DEFAULT_SIZE, root, source=catalogue.path(video.id),
                window=(top, 0, bottom - top, video.width_px), index=index,
            )  # fmt: skip
            fastest = {"prepare_cpu_seconds": math.inf, "prepare_scene_cpu_seconds": math.inf}
            for name in _TURNS * list(fastest):
                started = time.process_time()
                transcode(replace(job, scene="scene" in name))
                fastest[name] = min(fastest[name], time.process_time() - started)
            yield {"video": video.id, "frames": video.frames} | fastest | {"added_share": _added([fastest])}


def _added(records: Sequence[Record]) -> float:
    """Return which share of processor time the statistics add to preparing."""
    plain, scene = (sum(each[f"prepare_{name}cpu_seconds"] for each in records) for name in ("", "scene_"))
    return float(scene / plain - 1)


def figures(record: Record) -> dict[str, float]:
    """Return what the table shows of a clip in one form."""
    return {
        "ratio_to_source_bytes": record["bytes"] / record["source_bytes"],
        "bits_per_pixel": 8 * record["bytes"] / record["pixels"],
        "bytes_per_video_second": record["bytes"] / record["seconds"],
        **{key: record[key] for key in ("read_cpu_seconds", "write_bytes_per_cpu_second") if key in record},
    }


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "clips (python -m bench corpus)", rows="top:0.54")
    add_whole(parser, "--clips", 6, "most clips to take")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        CorpusError: no clip is long and large enough.
    """
    records = list(clips(asked))
    if not records:
        raise CorpusError(f"--videos {asked.videos}: no clip has {CROP[0]} frames of {CROP[1]} x {CROP[2]} px")
    found: list[Record] = [
        {"form": form, **medians([figures(each) for each in records if each["form"] == form])}
        for form in ("source", *FORMS)
    ]
    made = list(prepared(asked))
    added = _added(made)
    lines = [f"scene statistics add {added:.1%} to v2v-prepare"]
    missed = [f"{lines[0]}; the bar is {MOST_ADDED:.0%}"] if added > MOST_ADDED else []
    return Report([*records, *found, *made], [(found, _COLUMNS), (made, _PREPARED)], lines, missed)
