"""Two kinds of pixels and a plane, added to the packages as `docs/extending.md` says: one file and one line each."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from tests.stream.test_corpus_seams import OVERLAY
from tests.test_seams import add

ROOT = Path(__file__).parents[3]

RAW = '''
"""Frames without compression: a line of text "toy raw FRAMES HEIGHT WIDTH", and their bytes."""

from contextlib import nullcontext

import numpy as np

from v2v_server.video.decode import DecodedPicture
from v2v_server.video.decode import DecodedClip
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import unseekable
from v2v_server.video.picture import SDR
from v2v_server.video.probe import VideoFacts


class Raw:
    is_stored = False

    def __init__(self, path):
        self._path = path

    def _luma(self):
        head, _, body = self._path.read_bytes().partition(b"\\n")
        return np.frombuffer(body, np.uint8).reshape(tuple(map(int, head.split()[2:])))

    def facts(self):
        frames, height, width = self._luma().shape
        index = unseekable(frames, (1, 25), height, width)
        return VideoFacts(frames, height, width, "toy raw", "gray", 25.0, 0, True, index)

    def check(self, fingerprint):
        check_fingerprint(self._path, fingerprint)

    def clips(self, request):
        request.check()
        luma, found = self._luma(), []
        for cut in request.cuts:
            top, left, height, width = request.window(cut)
            end = request.start + (cut.count - 1) * request.stride + 1
            frames = luma[request.start : end : request.stride, top : top + height, left : left + width].copy()
            found.append(DecodedClip(frames, request.seconds(cut), "toy raw", True))
        return tuple(found)

    def pictures(self, request):
        (clip,) = self.clips(request)
        for grey in clip.frames:
            yield DecodedPicture(grey, grey, SDR, "toy raw", True)


def open_pixels(path):
    with path.open("rb") as file:
        return nullcontext(Raw(path)) if file.read(8) == b"toy raw " else None
'''

WORLD = '''
"""A grey level that a sample draws, and a true flow; "toy world" in the file. Every sample has its own."""

from contextlib import nullcontext

import numpy as np

from v2v_server.video.decode import DecodedPicture
from v2v_server.video.decode import DecodedClip
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import unseekable
from v2v_server.video.picture import SDR
from v2v_server.video.probe import VideoFacts

FRAMES, HEIGHT, WIDTH = 30, 32, 40


def drawn(sample):
    return np.random.default_rng(sample).integers(10, 200, 2)


class World:
    is_stored = False

    def __init__(self, path):
        self._path = path

    def facts(self):
        index = unseekable(FRAMES, (1, 25), HEIGHT, WIDTH)
        return VideoFacts(FRAMES, HEIGHT, WIDTH, "toy world", "gray", 25.0, 0, True, index)

    def check(self, fingerprint):
        check_fingerprint(self._path, fingerprint)

    def clips(self, request):
        found = []
        for cut, sample in zip(request.cuts, request.samples, strict=True):
            level, speed = drawn(sample)
            frames = np.empty((cut.count, *request.window(cut)[2:]), np.uint8)
            frames[:] = (level + np.arange(cut.count))[:, None, None]
            flow = np.full((2, 2, 16, 20), speed, np.float16)
            found.append(DecodedClip(frames, request.seconds(cut), "toy world", True, arrays={"flow": flow}))
        return tuple(found)

    def pictures(self, request):
        for _ in range(request.count):
            grey = np.zeros(request.window(request.cuts[0])[2:], np.uint8)
            yield DecodedPicture(grey, grey, SDR, "toy world", True)


def open_pixels(path):
    with path.open("rb") as file:
        return nullcontext(World(path)) if file.read(9) == b"toy world" else None
'''

PLANE = '''
"""The largest grey level of each square of 8 x 8 pixels."""

from dataclasses import replace

import numpy as np

from v2v_server.store.planes.plane import Plane


class Peaks(Plane):
    def is_wanted(self, request, signal):
        return True

    def maker(self):
        def peaks(picture):
            rows, columns = (-(-side // 8) for side in picture.grey.shape)
            padded = np.zeros((8 * rows, 8 * columns), np.uint8)
            padded[: picture.grey.shape[0], : picture.grey.shape[1]] = picture.grey
            return padded.reshape(1, rows, 8, columns, 8).max(axis=(2, 4))

        return peaks

    def read(self, files, request):
        values = []
        for cut in request.cuts:
            parts = []
            for stored, held in files:
                if "peaks" in stored.planes and (frames := range(held.start, min(held.stop, cut.count))):
                    first = request.start + frames.start * request.stride
                    parts.append(stored.plane("peaks", first, (len(frames) - 1) * request.stride + 1, (0, 0, 1, 1)))
            values.append(np.concatenate(parts) if parts else None)
        return values

    def added(self, clip, value):
        return clip if value is None else replace(clip, arrays={**clip.arrays, "peaks": value})


PLANE = Peaks(version=1, dtype="|u1", values=1, cell_px=8, serves="peaks")
'''

LINES = (
    ("v2v_server/kinds/videos.py", '"store_file", "video_file"', '"toy_raw", "toy_world", '),
    ("v2v_server/store/planes/__init__.py", '"motion", "detail"', '"peaks", '),
)

USE = """
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.digests.rows import Row, samples_of
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.prepare import prepare
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.pixels import signal_of
from v2v_server.store.store_file import StoreFile
from v2v_server.store.toy_world import drawn
from v2v_server.video.picture import SDR

root = Path(sys.argv[1])
row = Row("paper", count=4)


def opened(name):
    return closing(open_catalogue(root / name, cache_dir=root / "index", processes=0))


def arrays(catalogue, row=row, cache=None):
    return [sample.arrays for sample in samples_of(catalogue, row, cache)]


def require_equal(one, other):
    for first, second in zip(one, other, strict=True):
        assert all(first[name].tobytes() == second[name].tobytes() for name in first)


# A kind that reads another format: the samples of the same pictures, through store and cache too.
with opened("clips") as clips, opened("raw") as raw:
    expected = arrays(clips)
    require_equal(arrays(raw), expected)
    make_cache(root / "cache")
    cache = Cache(root / "cache", 1 << 30, least_free_bytes=0)
    require_equal(arrays(raw, cache=cache), expected)
    again = samples_of(raw, row, cache)
    found = {sample.provenance.decoder for sample in again}
    assert found == {"toy raw, from the cache"}, (found, cache.trouble)
    for source, name in ((raw, "store"), (clips, "peaks")):
        failed = prepare(source, root / name, processes=0, planes=("peaks",)).failed
        assert not failed, failed
with opened("store") as store:
    require_equal(arrays(store), expected)

# A plane: made, stored, read.
with StoreFile(root / "peaks" / "a.mkv") as stored:
    luma = np.frombuffer((root / "raw" / "a.mkv").read_bytes().partition(b"\\n")[2], np.uint8).reshape(30, 32, 40)
    assert stored.planes == {"peaks"}
    peaks = np.stack([*stored.arrays("peaks")])
    assert (peaks[:, 0] == luma.reshape(30, 4, 8, 5, 8).max(axis=(2, 4))).all()

# A kind that renders each sample, and knows its flow.
world = Row("paper-flow", ("frames", "flow"), {"samples_per_decode": 2, "sibling_spacing": 2}, count=4)
with opened("world") as catalogue:
    together = samples_of(catalogue, world)
    for index, sample in enumerate(together):
        level, speed = drawn((world.seed, 0, index))
        assert (sample.arrays["flow"] == np.float16(speed)).all()
        assert (sample.arrays["frames"] >= level).all() and (sample.arrays["frames"] < level + 30).all()
    with catalogue.source.open_pixels("a.mkv", "") as pixels:
        assert signal_of(pixels, catalogue.frame_index("a.mkv")) == SDR
    alone = samples_of(catalogue, replace(world, spec={}, count=1))
    require_equal([alone[0].arrays], [together[0].arrays])
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """The files with the additions, which an import prefers to those of the packages; a clip in both formats."""
    for name in ("store/planes", "kinds"):
        (tmp_path / "v2v_server" / name).mkdir(parents=True)
    for name, *_ in LINES:
        shutil.copy(ROOT / name, tmp_path / name)
    add(tmp_path, LINES)
    for name, text in (("toy_raw", RAW), ("toy_world", WORLD), ("planes/peaks", PLANE)):
        (tmp_path / f"v2v_server/store/{name}.py").write_text(text)
    (tmp_path / "sitecustomize.py").write_text(OVERLAY)
    for name in ("clips", "raw", "world"):
        (tmp_path / name).mkdir()
    luma = panned_luma(30, 32, 40)
    write_clip(tmp_path / "clips/a.mkv", luma, codec="ffv1", pixel_format="gray", full_range=True)
    (tmp_path / "raw/a.mkv").write_bytes(b"toy raw 30 32 40\n" + luma.tobytes())
    (tmp_path / "world/a.mkv").write_bytes(b"toy world")
    return tmp_path


def test_toys_are_a_file_and_a_line(tree: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-c", USE, str(tree)], env=environment, cwd=tree, capture_output=True, text=True,
        timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
