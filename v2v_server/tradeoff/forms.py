"""The corpus in all its forms: as it is, and prepared in several ways, each with still scenes.

Everything is in a temporary folder: links to a few different clips of the corpus, and their prepared forms, made by the
functions of ``v2v-prepare``. A still scene is one picture of a clip, repeated and coded as H.264: all its events come
from a coder.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.prepare.encode import encode_luma
from v2v_server.prepare.prepare import prepare
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.store.encoding import Encoding
from v2v_server.video.decode import decode_luma
from v2v_server.video.rows import Rows

SOURCE = "source"
ENCODINGS = {
    "lossless dense": Encoding("lossless", "dense"),
    "lossless fast": Encoding("lossless", "fast"),
} | {f"h264 {quality}": Encoding("h264", quality=quality, gop=25) for quality in (12, 18, 23)}
DEFAULT_FORMS = ("lossless dense", "lossless fast", "h264 12", "h264 18")
STILL_FRAMES = 250
STILL_ENCODING = Encoding("h264", quality=23, gop=STILL_FRAMES)


@dataclass(frozen=True, slots=True)
class CorpusForm:
    """The corpus in one form.

    Attributes:
        clips: the clips; equal indices give equal draws in every form.
        stills: the still scenes.
        nbytes: of the clips.
        seconds: duration of the clips.
    """

    clips: Catalogue
    stills: Catalogue
    nbytes: int
    seconds: float


@contextlib.contextmanager
def forms(
    videos: Path, rows: Rows, spec: StreamSpec, names: Sequence[str], *, most_clips: int, folder: Path, until: float,
    tell: Callable[[str], None],
) -> Iterator[dict[str, CorpusForm]]:  # fmt: skip
    """Make the forms.

    Args:
        videos: the corpus, not a prepared one.
        rows: rows of the pictures to use.
        spec: decides which clips are long and large enough.
        names: keys of ENCODINGS, in order.
        most_clips: number of clips to take: the first different ones.
        folder: an empty folder for all files.
        until: reading of ``time.monotonic`` after which no further form is made.
        tell: for progress.

    Yields:
        forms by name, SOURCE first; the catalogues are open inside the block.

    Raises:
        CorpusError: there is no clip, or one could not be prepared.
        UsageError: the corpus is a prepared one.
    """
    with contextlib.ExitStack() as stack:

        def opened(path: Path, of: Rows | None = None) -> Catalogue:
            catalogue = open_catalogue(path, rows=of, cache_dir=folder / "cache", processes=0)
            stack.callback(catalogue.close)
            return catalogue

        links, scenes = folder / "clips", folder / "stills"
        _link(opened(videos, rows), spec, most_clips, links)
        source = opened(links, rows)
        _make_stills(source, scenes)
        stills = opened(scenes, rows)
        made = {SOURCE: CorpusForm(source, stills, _nbytes(source), _seconds(source))}
        for name in names:
            if time.monotonic() >= until:
                tell(f"left out for lack of time: {name}")
                continue
            tell(f"preparing {len(source.videos)} clips as {name}")
            into = folder / name.replace(" ", "-")
            for what, catalogue in (("clips", source), ("stills", stills)):
                failed = prepare(catalogue, into / what, ENCODINGS[name], processes=0, floor_db=0.0).failed
                if failed:
                    raise CorpusError(f"{failed[0].id} could not be prepared as {name}: {failed[0].problem}")
            clips = opened(into / "clips")
            made[name] = CorpusForm(clips, opened(into / "stills"), _nbytes(clips), _seconds(source))
        yield made


def _nbytes(catalogue: Catalogue) -> int:
    return sum(catalogue.path(video.id).stat().st_size for video in catalogue.videos)


def _seconds(catalogue: Catalogue) -> float:
    return sum(video.frames / video.frames_per_second for video in catalogue.videos if video.frames_per_second)


def _link(catalogue: Catalogue, spec: StreamSpec, most: int, folder: Path) -> None:
    if catalogue.prepared is not None:
        raise UsageError(f"--videos {catalogue.folder}: a prepared corpus; give its source")
    table = SequenceTable(catalogue.videos, catalogue.rows, spec)
    if not table.count:
        raise CorpusError(f"--videos {catalogue.folder}: no video gives a sequence: {table.refusals[0]}")
    unusable = {refusal.video for refusal in table.refusals}
    distinct = {video.fingerprint: video for video in reversed(catalogue.videos) if video.id not in unusable}
    folder.mkdir(parents=True)
    for number, video in enumerate(sorted(distinct.values(), key=lambda video: video.id)[:most]):
        path = catalogue.path(video.id)
        (folder / f"{number:03d}_{path.name}").symlink_to(path.resolve())


def _make_stills(source: Catalogue, scenes: Path, most: int = 2) -> None:
    scenes.mkdir()
    for number, video in enumerate(source.videos[:most]):
        index = source.frame_index(video.id)
        (picture,) = decode_luma(source.path(video.id), index, video.frames // 2, 1).frames
        encode_luma(
            scenes / f"{number}.mp4", itertools.repeat(picture, STILL_FRAMES), STILL_ENCODING,
            height=picture.shape[0], width=picture.shape[1], pts=range(STILL_FRAMES), time_base=Fraction(1, 30),
        )  # fmt: skip
