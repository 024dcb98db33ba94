"""Measure time and memory of a catalogue of a million videos.

    python -m bench catalogue --clip FILE.mp4 --videos 1000000

The corpus is synthetic: one clip under many names (hard links to a few copies), a thousand names a folder, and a
complete index, as a second start finds it. Files and index are below TMPDIR and are removed at the end. A fresh
process opens the catalogue.

    open           seconds to open the catalogue, and processor time
    table          seconds to build the sequence table of the paper's recipe
    resident       memory that both added to the process, and the peak

With --archive, the same names are made as a folder and as a tar file, and both are opened twice without an index: the
first start probes each video. A sample's processor time is that of a decoded clip, the median of its turns.

    first, second  seconds to open the catalogue at the first and the second start
    sample         processor time of a clip
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from bench.frame import Column, Report, add_whole
from tests.packed import packed_forms
from tests.pieces import shots
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.index import Figures, Store
from v2v_server.corpus.probe import SceneCollection, figures, probe_file
from v2v_server.corpus.scenes.scene import COLUMNS, MOST_ANALYSED_FRAMES, SEGMENT_FRAMES, Scene
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.videos import IndexRow
from v2v_server.kinds.registry import kind_of
from v2v_server.schedule import SequenceTable
from v2v_server.system.process import resident_bytes, usable_cores
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.rows import Rows

_PER_FOLDER = 1000
_LINKS = 50_000  # Hard links to one file; ext4 allows at most 65,000
_COLUMNS: tuple[Column, ...] = (
    ("videos", "videos", "{}", 1),
    ("open_seconds", "open s", "{:.2f}", 1.0),
    ("open_cpu_seconds", "CPU s", "{:.2f}", 1.0),
    ("table_seconds", "table s", "{:.2f}", 1.0),
    ("resident_bytes", "resident MiB", "{:.0f}", 2.0**-20),
    ("peak_bytes", "peak MiB", "{:.0f}", 2.0**-20),
)

_ARCHIVE_COLUMNS: tuple[Column, ...] = (
    ("form", "form", "{}", 1),
    ("videos", "videos", "{}", 1),
    ("first_seconds", "first s", "{:.2f}", 1.0),
    ("second_seconds", "second s", "{:.3f}", 1.0),
    ("sample_cpu_seconds", "sample CPU ms", "{:.2f}", 1e3),
    ("first_ratio", "first ratio", "{:.2f}", 1.0),
    ("second_ratio", "second ratio", "{:.2f}", 1.0),
    ("sample_cpu_ratio", "sample ratio", "{:.3f}", 1.0),
)
_TURNS = 20


def make_up(clip: Path, folder: Path, cache: Path, videos: int, scene: bool = False) -> None:
    """Make ``videos`` names below ``folder`` and their index in ``cache``.

    With ``scene`` the index has scene data too: every third video has a shot boundary in the middle.

    Raises:
        UsageError: the clip cannot be served.
    """
    copies = folder.with_name("copies")
    copies.mkdir()
    ids = []
    for number in range(videos):
        if number % _LINKS == 0:
            copy = copies / f"{number}{clip.suffix}"
            shutil.copy(clip, copy)
        id = f"{number // _PER_FOLDER:06d}/{1_000_000_000 + number}{clip.suffix}"
        if number % _PER_FOLDER == 0:
            (folder / id).parent.mkdir(parents=True)
        (folder / id).hardlink_to(copy)
        ids.append(id)
    known = probe_file(Folder(folder), (ids[0], ()))
    if known.problem is not None:
        raise UsageError(f"--clip {clip}: {known.problem}")
    store = Store(index_path(folder.resolve(), cache))

    def rows() -> Iterator[IndexRow]:
        for number, id in enumerate(ids):
            if number % _LINKS == 0:  # a hard link changes the ctime of its file: read it after the last link
                status = (folder / id).stat()
            yield dataclasses.replace(known, id=id, mtime_ns=status.st_mtime_ns, ctime_ns=status.st_ctime_ns)

    def scenes() -> Iterator[Figures]:
        end = min(known.frames, MOST_ANALYSED_FRAMES)
        values = np.random.default_rng(0).uniform(1.0, 10.0, (-(-end // SEGMENT_FRAMES), COLUMNS))
        whole, split = (figures(known, Scene.of(pieces, values)) for pieces in (shots(end), shots(end, end // 2)))
        for number, id in enumerate(ids):
            yield dataclasses.replace(whole if number % 3 else split, id=id)

    try:
        store.put(rows())
        if scene:
            store.make_figures()
            store.put_figures(SceneCollection(Rows()).kind, scenes())
    finally:
        store.close()


def opened(folder: Path, cache: Path, scene: bool = False) -> dict[str, Any]:
    """Open the catalogue in this process, which must be a fresh one; return the record."""
    before = resident_bytes()
    began, cpu = time.perf_counter(), sum(os.times()[:2])
    catalogue = open_catalogue(folder, cache_dir=cache, processes=usable_cores(), scene=scene)
    record: dict[str, Any] = {
        "open_seconds": time.perf_counter() - began,
        "open_cpu_seconds": sum(os.times()[:2]) - cpu,
    }
    began = time.perf_counter()
    table = SequenceTable(catalogue.videos, catalogue.rows, StreamSpec())
    record |= {
        "table_seconds": time.perf_counter() - began,
        "videos": len(catalogue.videos),
        "sequences": table.count,
        "resident_bytes": resident_bytes() - before,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before,
    }
    catalogue.close()
    return record


def compared(clip: Path, place: Path, videos: int) -> list[dict[str, Any]]:
    """Return the records of a folder and of a tar file of it."""
    for number in range(videos):
        path = place / "folder" / "0" / f"{number:06}{clip.suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(clip, path)
    records = []
    for form, folder in packed_forms(place / "folder", place).items():
        if form == "zip":
            continue
        record: dict[str, Any] = {"form": form, "videos": videos}
        for start in ("first", "second"):
            began = time.perf_counter()
            catalogue = open_catalogue(folder, cache_dir=place / form, processes=usable_cores())
            record[f"{start}_seconds"] = time.perf_counter() - began
            if start == "first":
                catalogue.close()
        with closing(catalogue):
            record["sample_cpu_seconds"] = _clip_seconds(catalogue)
        records.append(record)
    for name in ("first_seconds", "second_seconds", "sample_cpu_seconds"):
        records[1][name.replace("seconds", "ratio")] = records[1][name] / records[0][name]
    return records


def _clip_seconds(catalogue: Catalogue) -> float:
    """Return the processor time of a decoded clip of 41 frames: the median of the turns."""
    turns = []
    for video in catalogue.videos[:_TURNS]:
        index = catalogue.frame_index(video.id)
        request = ClipRequest(index, 0, (Cut(min(41, len(index)), (0, 0, video.height_px, video.width_px)),))
        with catalogue.lend(video) as path, kind_of(video.id).open_pixels(path) as pixels:
            began = time.process_time()
            pixels.clips(request)
            turns.append(time.process_time() - began)
    return float(np.median(turns))


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--clip", required=True, type=Path, help="a short video of at least 201 frames")
    add_whole(parser, "--videos", 1_000_000, "names to make")
    parser.add_argument("--archive", action="store_true", help="compare a folder and a tar file without an index")
    parser.add_argument("--scene", action="store_true", help="with scene data, as v2v-serve --scene auto")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with tempfile.TemporaryDirectory(prefix="v2v-catalogue-") as place:
        if asked.archive:
            records = compared(asked.clip, Path(place), asked.videos)
            return Report(records, [(records, _ARCHIVE_COLUMNS)])
        folder, cache = Path(place, "videos"), Path(place, "cache")
        make_up(asked.clip, folder, cache, asked.videos, asked.scene)
        # The processes of a Pool must not have children.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
            record = fresh.submit(opened, folder, cache, asked.scene).result()
    return Report([record], [([record], _COLUMNS)])
