"""The corpus in all its forms: as it is, and prepared in several ways.

Everything is in a temporary folder: links to a few different clips of the corpus, and their prepared forms, made by the
functions of ``v2v-prepare``.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.prepare.prepare import prepare
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.store.encoding import Encoding
from v2v_server.store.motion import MADE_PLANES
from v2v_server.video.rows import Rows

SOURCE = "source"
ENCODINGS = {
    "lossless dense": Encoding("lossless", "dense"),
    "lossless fast": Encoding("lossless", "fast"),
} | {f"h264 {quality}": Encoding("h264", quality=quality, gop=25) for quality in (12, 18, 23)}
DEFAULT_FORMS = ("lossless dense", "lossless fast", "h264 12", "h264 18")


@dataclass(frozen=True, slots=True)
class CorpusForm:
    """The corpus in one form.

    Attributes:
        clips: the clips; equal indices give equal draws in every form.
        nbytes: of the clips.
        seconds: duration of the clips.
    """

    clips: Catalogue
    nbytes: int
    seconds: float


@contextlib.contextmanager
def forms(
    videos: Path, rows: Rows, spec: StreamSpec, names: Sequence[str], *, motion: bool, most_clips: int, folder: Path,
    until: float, tell: Callable[[str], None],
) -> Iterator[dict[str, CorpusForm]]:  # fmt: skip
    """Make the forms.

    Args:
        videos: the corpus, not a prepared one.
        rows: rows of the pictures to use.
        spec: decides which clips are long and large enough.
        names: keys of ENCODINGS, in order.
        motion: whether lossless forms hold the motion between frames.
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

        links = folder / "clips"
        _link(opened(videos, rows), spec, most_clips, links)
        source = opened(links, rows)
        made = {SOURCE: CorpusForm(source, _nbytes(source), _seconds(source))}
        for name in names:
            if time.monotonic() >= until:
                tell(f"left out for lack of time: {name}")
                continue
            tell(f"preparing {len(source.videos)} clips as {name}")
            how, into = ENCODINGS[name], folder / name.replace(" ", "-")
            planes = tuple(MADE_PLANES) if motion and how.is_lossless else ()
            failed = prepare(source, into, how, processes=0, floor_db=0.0, planes=planes).failed
            if failed:
                raise CorpusError(f"{failed[0].id} could not be prepared as {name}: {failed[0].problem}")
            clips = opened(into)
            made[name] = CorpusForm(clips, _nbytes(clips), _seconds(source))
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
