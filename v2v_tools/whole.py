"""`v2v-simulate --whole`: the events of whole videos, full frame, one recording for each video."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError, V2VError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.persisted import Persisted
from v2v_protocol.programs import counted, show
from v2v_protocol.progress import Progress
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import add_spec
from v2v_protocol.write_aside import check_outside, write_file
from v2v_recordings.writers import EVENT_FORMS, check_form, open_writer
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.kinds.registry import kind_from
from v2v_server.schedule import VideoSequence
from v2v_server.simulation.continued import ContinuedClip, part_of
from v2v_server.simulation.intensity import eight_bits
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.worker.making.make import simulate
from v2v_tools.remake import lease_for
from v2v_tools.sample_flags import add_corpus, add_folder, asked_catalogue, asked_spec, make_folder
from v2v_tools.whole_clip import WholeClip, spec_of_whole

_PLANES = ("images",)
"""Kinds of pictures that a recording of a whole video may have."""


@dataclass(frozen=True, slots=True)
class WholeVideo(Persisted):
    """One video to make events of.

    Attributes:
        lease: its clip, and the camera; the index of all its frames.
        shots: first frame of each shot after the first one, stride applied.
        path: the recording.
        form: its form, a key of ``EVENT_FORMS``.
        has_frames: whether pictures are written too.
        frames: number of frames.
    """

    lease: Lease
    shots: tuple[int, ...]
    path: Path
    form: str
    has_frames: bool
    frames: int

    @property
    def note(self) -> Path:
        """Return the path of the provenance, which is written last: with it, the recording is complete."""
        return self.path.with_name(f"{self.path.name}.provenance.json")


@dataclass(frozen=True, slots=True)
class Outcome(Persisted):
    """What became of a video: number of events and of frames, or why there is no recording."""

    events: int = 0
    frames: int = 0
    problem: str = ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-simulate --whole", "VIDEO|DIR --out DIR --events FORM [flags]",
        "Make the events of whole videos: full frame, whole length, one recording for each video.",
        [
            "v2v-simulate --whole clip.mp4 --out events/ --events h5",
            "v2v-simulate --whole videos/ --out events/ --events raw --recipe davis346-measured --jobs 4",
        ],
    )  # fmt: skip
    which = add_corpus(parser, "Which videos", "a video, a folder of videos, or a list file")
    which.add_argument("--whole", action="store_true", required=True, help="make events of whole videos")
    out = add_folder(parser, "the recordings")
    out.add_argument("--frames", action="store_true", help="also write the frames as the camera sees them")
    out.add_argument("--jobs", type=int, default=1, metavar="N", help="videos at a time (default 1)")
    add_spec(parser)
    return run_command(
        parser, _run, argv, failures=(V2VError,),
        interrupted="interrupted: the same command goes on with the videos that are not complete",
    )  # fmt: skip


def _run(asked: argparse.Namespace) -> int:
    """Make a recording of each video that has none; return the exit status."""
    spec = asked_spec(asked)
    kind = kind_from(vars(asked))
    if not kind.is_simulated:
        raise UsageError(f"--whole with {kind.name}: they have events of their own, in their raw files")
    if kind.is_view:
        raise UsageError(
            "--whole with photographs: a photograph has no length, and its motion is drawn for each sample; write "
            "samples of them with --count N, as long as --set voxels_per_clip=N says"
        )
    if asked.jobs < 1:
        raise UsageError(f"--jobs {asked.jobs}: give a whole number from 1")
    check_outside("--out", asked.out, filter(None, (asked.video, asked.list)))
    catalogue = asked_catalogue(asked, spec)
    make_folder(asked.out)
    failed, jobs = len(catalogue.refusals), list[WholeVideo]()
    for rank in range(len(catalogue.videos)):
        try:
            jobs.append(whole_video(catalogue, rank, spec, asked))
        except VideoError as error:
            failed += 1
            show(str(error))
    left = [job for job in jobs if not is_complete(job)]
    if len(left) < len(jobs):
        show(f"{counted(len(jobs) - len(left), 'video')} of {len(jobs)} complete already")
    with Progress("simulating", "frames") as progress:
        for job, outcome in _outcomes(catalogue.source, left, asked.jobs, progress):
            failed += bool(outcome.problem)
            show(
                f"{job.lease.video}: {outcome.problem}" if outcome.problem else
                f"{job.lease.video}: {outcome.events} events of {outcome.frames} frames written to {job.path}"
            )  # fmt: skip
    return FAILED if failed else 0


def whole_video(catalogue: Catalogue, rank: int, spec: StreamSpec, asked: argparse.Namespace) -> WholeVideo:
    """Return the job of the video that is ``rank`` in the catalogue's order.

    Raises:
        UsageError: the form cannot hold the picture.
        VideoError: it has a single frame, or its frame rate is unknown.
        V2VError: its index cannot be read.
    """
    video = catalogue.videos[rank]
    whole = spec_of_whole(spec, video, catalogue.rows)
    path = asked.out / f"{video.id.rstrip('/')}{EVENT_FORMS[asked.events].ending}"
    check_form(path, asked.events, whole.recipe.crop_px[::-1], _PLANES if asked.frames else ())
    lease = lease_for(
        Request(b"", asked.epoch, rank), sequence=VideoSequence(video, 0), catalogue=catalogue, spec=whole,
        seed=asked.seed, arrays=(),
    )  # fmt: skip
    found = () if spec.scene == "off" else catalogue.scene(video.id).shot_boundaries
    shots = sorted({-(-shot // whole.recipe.frame_stride) for shot in found})
    return WholeVideo(lease, tuple(shots), path, asked.events, asked.frames, whole.recipe.steps + 1)


def is_complete(job: WholeVideo) -> bool:
    """Return whether an earlier run has made this recording.

    Raises:
        UsageError: there is one with another camera or of another video.
    """
    try:
        known = json.loads(job.note.read_bytes())
    except (OSError, ValueError):
        return False
    asked = _identity(job)
    if {name: known.get(name) for name in asked} != asked:
        raise UsageError(f"{job.path}: made with other settings, or of another video; give another --out")
    return job.path.exists()


def _identity(job: WholeVideo) -> dict[str, Any]:
    """Return what names a recording: equal values, equal events."""
    lease = job.lease
    return {
        "video": lease.video, "fingerprint": lease.fingerprint, "spec": json.loads(lease.spec), "rows": lease.rows,
        "seed": lease.seed, "epoch": lease.epoch, "index": lease.indices[0], "numerics_version": NUMERICS_VERSION,
        "shots": [0, *job.shots], "has_frames": job.has_frames, "form": job.form,
    }  # fmt: skip


def _outcomes(
    source: VideoSource, jobs: Sequence[WholeVideo], processes: int, progress: Progress
) -> Iterator[tuple[WholeVideo, Outcome]]:
    """Yield what becomes of each video, in order of completion."""
    total, done = sum(job.frames for job in jobs), 0

    def advance(frames: int) -> None:
        nonlocal done
        done += frames
        progress(done, total)

    if processes == 1:
        for job in jobs:
            yield job, attempt(source, job, advance)
        return
    for job, result in run_isolated(partial(_attempt_reopened, source.to_bytes()), jobs, processes):
        advance(job.frames)
        yield job, Outcome(problem=f"its process died: {result.how}") if isinstance(result, Died) else result


def _attempt_reopened(source: bytes, job: WholeVideo) -> Outcome:
    return attempt(VideoSource.from_bytes(source), job, lambda _: None)


def attempt(source: VideoSource, job: WholeVideo, advance: Callable[[int], None]) -> Outcome:
    """Make a recording; return what became of it. ``advance`` is told the number of frames after each part."""
    try:
        return make_recording(source, job, advance)
    except V2VError as error:
        return Outcome(problem=str(error))
    except OSError as error:
        return Outcome(problem=f"{job.path}: cannot be written: {error.strerror or error}")


def make_recording(source: VideoSource, job: WholeVideo, advance: Callable[[int], None]) -> Outcome:
    """Make the recording of a video, and its provenance, in bounded memory.

    Raises:
        UsageError, OSError: it cannot be written.
        VideoError: the video cannot be read, or its frame rate is unknown.
    """
    clip = WholeClip(job.lease)
    job.path.parent.mkdir(parents=True, exist_ok=True)
    camera = ContinuedClip()
    with open_writer(job.path, job.form, clip.size, _PLANES if job.has_frames else ()) as writer:
        for first, context in clip.parts(source):
            last = first + len(context.view) - 1
            if job.has_frames:
                pictures = eight_bits(context.view, context.signal)
                for number in range(first + (first > 0), last + 1):
                    writer.add_plane("images", int(clip.since_us[number]), pictures[number - first])
            given = simulate(context, {}).given
            cuts = [shot for shot in job.shots if first < shot <= last]
            for begin, end in zip((first, *cuts), (*(cut - 1 for cut in cuts), last), strict=True):
                if begin in job.shots:
                    camera.restart()
                part = part_of(given, begin - first, end - first)
                for found in camera.events(part, clip.since_us[begin : end + 1]):
                    writer.add(found)
            advance(last - first + (first == 0))
    record = _identity(job) | {
        "params": context.params.to_dict(), "frames": job.frames, "events": writer.events, "remark": job.lease.remark
    }  # fmt: skip
    write_file(job.note, json.dumps(record, indent=1) + "\n")
    return Outcome(writer.events, job.frames)
