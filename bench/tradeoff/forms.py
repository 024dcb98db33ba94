"""The corpus in all its forms: as it is, and prepared in several ways, with still scenes beside it.

Everything lies in a temporary folder: links to a few clips of the corpus that are all different, and what
``v2v-prepare``'s own functions make of them. The still scenes are one picture of each clip, repeated and coded like the
clips of ``bench.corpus``; whatever fires there comes from a coder.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from bench.corpus import webvid_like
from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
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
_STILL_GOP = 250


@dataclass(frozen=True, slots=True)
class Form:
    """The corpus in one form.

    Attributes:
        clips: the clips; equal indices give equal draws in every form.
        stills: the still scenes.
        nbytes: of the clips.
        seconds: that the clips last.
    """

    clips: Catalogue
    stills: Catalogue
    nbytes: int
    seconds: float


@contextlib.contextmanager
def forms(
    videos: Path, rows: Rows, spec: StreamSpec, names: Sequence[str], *, most_clips: int, folder: Path
) -> Iterator[dict[str, Form]]:
    """Makes them.

    Args:
        videos: the corpus, not a prepared one.
        rows: rows of the pictures to use.
        spec: says which clips are long and large enough.
        names: keys of ENCODINGS.
        most_clips: how many clips are taken, the first ones that differ.
        folder: empty; belongs to this function.

    Yields:
        by name, SOURCE first; the catalogues are open inside the block.

    Raises:
        CorpusError: there is no clip, or one could not be prepared.
        UsageError: the corpus is prepared already.
    """
    with contextlib.ExitStack() as stack:

        def opened(path: Path, of: Rows | None = None) -> Catalogue:
            catalogue = open_catalogue(path, rows=of, cache_dir=folder / "cache", processes=0)
            stack.callback(catalogue.close)
            return catalogue

        links, scenes = folder / "clips", folder / "stills"
        _link(opened(videos, rows), spec, most_clips, links)
        source = opened(links, rows)
        _make_stills(source, folder / "pictures", scenes)
        stills = opened(scenes, rows)
        made = {SOURCE: Form(source, stills, _nbytes(source), _seconds(source))}
        for name in names:
            print(f"preparing {len(source.videos)} clips as {name}", file=sys.stderr, flush=True)
            into = folder / name.replace(" ", "-")
            for what, catalogue in (("clips", source), ("stills", stills)):
                failed = prepare(catalogue, into / what, ENCODINGS[name], processes=0, floor_db=0.0).failed
                if failed:
                    raise CorpusError(f"{failed[0].id} could not be prepared as {name}: {failed[0].problem}")
            clips = opened(into / "clips")
            made[name] = Form(clips, opened(into / "stills"), _nbytes(clips), _seconds(source))
        yield made


def _nbytes(catalogue: Catalogue) -> int:
    return sum(catalogue.path(video.id).stat().st_size for video in catalogue.videos)


def _seconds(catalogue: Catalogue) -> float:
    return sum(video.frames / video.frames_per_second for video in catalogue.videos if video.frames_per_second)


def _link(catalogue: Catalogue, spec: StreamSpec, most: int, folder: Path) -> None:
    if catalogue.prepared is not None:
        raise UsageError(
            f"--videos {catalogue.folder} is a prepared corpus: give its source, which this command prepares"
        )
    table = SequenceTable(catalogue.videos, catalogue.rows, spec)
    if not table.count:
        raise CorpusError(
            f"--videos {catalogue.folder}: no video gives a sequence of {spec.recipe.frames_needed} frames"
        )
    unusable = {refusal.video for refusal in table.refusals}
    distinct = {video.fingerprint: video for video in reversed(catalogue.videos) if video.id not in unusable}
    folder.mkdir(parents=True)
    for number, video in enumerate(sorted(distinct.values(), key=lambda video: video.id)[:most]):
        path = catalogue.path(video.id)
        (folder / f"{number:03d}_{path.name}").symlink_to(path.resolve())


def _make_stills(source: Catalogue, pictures: Path, scenes: Path, most: int = 2) -> None:
    pictures.mkdir()
    paths: list[Path] = []
    for video in source.videos[:most]:
        index = source.frame_index(video.id)
        luma = decode_luma(source.path(video.id), index, video.frames // 2, 1).frames
        paths.append(pictures / f"{len(paths)}.mp4")
        height, width = luma.shape[1:]
        encode_luma(
            paths[-1],
            luma,
            Encoding("h264", quality=1, gop=1),
            height=height,
            width=width,
            pts=[0],
            time_base=Fraction(1, 25),
        )
    webvid_like(paths, scenes, gop=_STILL_GOP, frames=STILL_FRAMES, clips=len(paths))
