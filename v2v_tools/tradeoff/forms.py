"""The corpus in all its forms: as it is, prepared in several ways, and as another folder has it.

Everything is in a temporary folder: links to a few different clips of the corpus and of the other folder, and stores,
made by the functions of ``v2v-prepare``.
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
from v2v_server.prepare import prepare
from v2v_server.schedule import SequenceTable
from v2v_server.video.rows import Rows

SOURCE, BESIDE = "source", "beside"
STORES = {"lossless dense": "dense", "lossless fast": "fast", "lossless raw": "raw"}
"""Sizes of stores, by form."""
DEFAULT_FORMS = ("lossless dense", "lossless fast")


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
    videos: Path, rows: Rows, spec: StreamSpec, names: Sequence[str], *, beside: Path | None, planes: Sequence[str],
    most_clips: int, folder: Path, until: float, tell: Callable[[str], None],
) -> Iterator[dict[str, CorpusForm]]:  # fmt: skip
    """Make the forms.

    Args:
        videos: the corpus, not a prepared one.
        rows: rows of the pictures to use.
        spec: decides which clips are long and large enough.
        names: keys of STORES, in order.
        beside: a folder that has each clip under the same name, in another encoding; None: there is none.
        planes: of the stores.
        most_clips: number of clips to take: the first different ones.
        folder: an empty folder for all files.
        until: reading of ``time.monotonic`` after which no further form is made.
        tell: for progress.

    Yields:
        forms by name, SOURCE first, then BESIDE; the catalogues are open inside the block.

    Raises:
        CorpusError: there is no clip, one could not be prepared, or ``beside`` lacks one or has it with other frames.
        UsageError: the corpus is a prepared one.
    """
    with contextlib.ExitStack() as stack:

        def opened(path: Path, of: Rows | None = None) -> Catalogue:
            catalogue = open_catalogue(path, rows=of, cache_dir=folder / "cache", processes=0)
            stack.callback(catalogue.close)
            return catalogue

        links = folder / "clips"
        chosen = _chosen(opened(videos, rows), spec, most_clips)
        _link(videos, chosen, links)
        source = opened(links, rows)
        made = {SOURCE: CorpusForm(source, _nbytes(source), _seconds(source))}
        if beside is not None:
            _link(beside, chosen, folder / BESIDE)
            clips = opened(folder / BESIDE, rows)
            _require_alike(source, clips, beside)
            made[BESIDE] = CorpusForm(clips, _nbytes(clips), _seconds(source))
        for name in names:
            if time.monotonic() >= until:
                tell(f"left out for lack of time: {name}")
                continue
            tell(f"preparing {len(source.videos)} clips as {name}")
            into = folder / name.replace(" ", "-")
            failed = prepare(source, into, STORES[name], processes=0, planes=tuple(planes)).failed
            if failed:
                raise CorpusError(f"{failed[0].id} could not be prepared as {name}: {failed[0].problem}")
            clips = opened(into)
            made[name] = CorpusForm(clips, _nbytes(clips), _seconds(source))
        yield made


def _nbytes(catalogue: Catalogue) -> int:
    return sum(catalogue.path(video.id).stat().st_size for video in catalogue.videos)


def _seconds(catalogue: Catalogue) -> float:
    return sum(video.frames / video.frames_per_second for video in catalogue.videos if video.frames_per_second)


def _chosen(catalogue: Catalogue, spec: StreamSpec, most: int) -> list[str]:
    """Return the ids of the first different clips."""
    if catalogue.prepared is not None:
        raise UsageError(f"--videos {catalogue.folder}: a prepared corpus; give its source")
    table = SequenceTable(catalogue.videos, catalogue.rows, spec)
    if not table.count:
        raise CorpusError(f"--videos {catalogue.folder}: no video gives a sequence: {table.refusals[0]}")
    unusable = {refusal.video for refusal in table.refusals}
    distinct = {video.fingerprint: video for video in reversed(catalogue.videos) if video.id not in unusable}
    return sorted(video.id for video in distinct.values())[:most]


def _link(videos: Path, ids: Sequence[str], folder: Path) -> None:
    """Link some videos of a folder, or of the folder of a list file, under names that tell them apart."""
    root = videos if videos.is_dir() else videos.parent
    folder.mkdir(parents=True)
    for number, id in enumerate(ids):
        if not (root / id).exists():
            raise CorpusError(f"{root / id}: there is no such file: give a folder with each clip under its own name")
        (folder / f"{number:03d}_{Path(id).name}").symlink_to((root / id).resolve())


def _require_alike(source: Catalogue, other: Catalogue, folder: Path) -> None:
    """Check that both have the same videos, with equal numbers and sizes of frames."""
    for video in source.videos:
        found = other.videos.find(video.id)
        if found is None:
            raise CorpusError(f"{folder}: {video.id[4:]} cannot be used")
        with_size = ((each.frames, each.height_px, each.width_px) for each in (video, other.videos[found]))
        (frames, height, width), (got, tall, wide) = with_size
        if (got, tall, wide) != (frames, height, width):
            raise CorpusError(
                f"{folder}: {video.id[4:]} has {got} frames of {wide}x{tall} px instead of {frames} of "
                f"{width}x{height} px: encode it again with all frames in their size"
            )
