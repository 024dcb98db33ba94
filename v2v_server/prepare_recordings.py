"""`v2v-prepare --videos-kind recordings`: raw recordings of any form, written in the form that is served.

The destination mirrors the source: ``a/b.h5`` becomes ``a/b.h5.v2ve`` (:mod:`v2v_recordings.block_file`). A raw
recording is read in a process that can only read, compute and write there, with a limit of memory, and of time by its
size. A file has its final name once it is complete. A second run keeps the files whose sources have not changed.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError, VideoError, system_errors
from v2v_protocol.persisted import Persisted
from v2v_recordings.block_file import ENDING, EventFileWriter
from v2v_recordings.items import ConvertOptions
from v2v_recordings.reading import FORMS, read_items, recognise
from v2v_recordings.text_events import TEXT_SUFFIXES
from v2v_server.store.event_file import EventFile
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.video.fingerprint import fingerprint, fingerprint_of

MOST_MEMORY_BYTES = 3 << 30
_LEAST_SECONDS, _BYTES_A_SECOND = 60.0, 1e5
"""Time limit of a recording: the least, and a fiftieth of the speed at which texts are read."""


@dataclass(frozen=True, slots=True)
class Conversion(Persisted):
    """One recording to convert.

    Attributes:
        id: its path below the source.
        source: its file or folder.
        target: the file to write.
        bytes: its size.
    """

    id: str
    source: Path
    target: Path
    bytes: int


@dataclass(frozen=True, slots=True)
class PreparedRecording(Persisted):
    """What became of a recording.

    Attributes:
        id: its path below the source.
        bytes: size of its prepared file; 0 with a problem.
        events, pictures, flows: numbers of them.
        notes: sentences of the reader for the user.
        problem: why there is no prepared file; "" if there is one.
        is_kept: whether an earlier run had written it.
    """

    id: str
    bytes: int = 0
    events: int = 0
    pictures: int = 0
    flows: int = 0
    notes: tuple[str, ...] = ()
    problem: str = ""
    is_kept: bool = False


def convert_recordings(source: Path, destination: Path, processes: int) -> Iterator[PreparedRecording]:
    """Convert the recordings in a folder, or one, and yield what became of each, in order of completion.

    Raises:
        CorpusError: there are none, or the destination overlaps with the source or cannot be written to.
        UsageError: there is no such source.
    """
    root, target = source.resolve(), destination.resolve()
    if root.is_relative_to(target) or (root.is_dir() and target.is_relative_to(root)):
        raise CorpusError(f"{target} and the source {root} overlap; choose a destination outside the source")
    jobs = list(recordings_in(root, target))
    if not jobs:
        raise CorpusError(
            f"{source}: holds no recording of a known form; v2v-convert --help lists the forms, and converts what "
            "needs more flags to .h5, which is one"
        )
    with system_errors(CorpusError, f"{target}: cannot be written to"):
        for job in jobs:
            job.target.parent.mkdir(parents=True, exist_ok=True)
    for job, result in run_isolated(
        convert_recording, jobs, processes, lambda job: _LEAST_SECONDS + job.bytes / _BYTES_A_SECOND,
        MOST_MEMORY_BYTES, (target,),
    ):  # fmt: skip
        if isinstance(result, Died):
            how = result.how if result.overdue_seconds else f"died ({result.how})"
            result = PreparedRecording(job.id, problem=f"cannot be read: the process that read it {how}")
        yield result


def recordings_in(source: Path, destination: Path) -> Iterator[Conversion]:
    """Yield the recordings in a folder and those below it, or the one that ``source`` is, in the order of their names.

    Raises:
        UsageError: ``source`` is missing, or a file that is no recording.
    """
    if not source.is_dir():
        recognise(source)
    for path in _recordings_below(source):
        yield _job(path, source.parent if path == source else source, destination)


def _recordings_below(path: Path) -> Iterator[Path]:
    """Yield a file or folder if it is a recording, else those in a folder. What it consists of is named as events are,
    or is a text.
    """
    is_recording, inside = _is_recording(path), list[Path]()
    if path.is_dir():
        inside = [each for each in sorted(path.iterdir()) if not (each.name.startswith(".") or each.is_symlink())]
    if is_recording and all(_is_part(each) or not _is_recording(each) for each in inside):
        yield path
        return
    for each in inside:
        yield from _recordings_below(each)


def _is_part(path: Path) -> bool:
    return path.name.lower().startswith("events") or path.suffix.lower() in TEXT_SUFFIXES


def _is_recording(path: Path) -> bool:
    try:
        return any(form.recognises(path) for form in FORMS.values())
    except (UsageError, OSError):
        return True  # a damaged one, which is refused with the reason


def _job(path: Path, root: Path, destination: Path) -> Conversion:
    id = path.relative_to(root).as_posix()
    return Conversion(id, path, destination / f"{id}{ENDING}", sum(size for _, size in _sizes(path)))


def _sizes(path: Path) -> list[tuple[str, int]]:
    """Return the sizes of a file, or of all files below a folder by their paths."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    return [(each.relative_to(path).as_posix(), each.stat().st_size) for each in files]


def convert_recording(job: Conversion) -> PreparedRecording:
    """Convert one recording. Its prepared file is either the complete one or the earlier one."""
    tempfile.tempdir = os.fspath(job.target.parent)  # the only place where this process may write
    try:
        name = fingerprint_of(dict(_sizes(job.source))) if job.source.is_dir() else fingerprint(job.source)
        if (found := _standing(job, name)) is None:
            with EventFileWriter(job.target, source=job.id, fingerprint=name) as writer:
                for item in read_items(job.source, None, ConvertOptions()):
                    writer.add(item)
            found = replace(_standing(job, name) or PreparedRecording(job.id), is_kept=False)
        return found
    except (UsageError, VideoError) as error:
        more = "; v2v-convert takes such flags, and its .h5 states all that they do" if " --" in str(error) else ""
        why = f"{error}{more}"
    except MemoryError:
        why = f"reading it takes more than {MOST_MEMORY_BYTES >> 30} GiB of memory"
    except OSError as error:
        why = f"cannot be read or written: {error.strerror or error}"
    except Exception as error:  # noqa: BLE001 - one strange file must not end the conversion of all others
        why = f"converting failed: {type(error).__name__}: {error}"
    return PreparedRecording(job.id, problem=why)


def _standing(job: Conversion, name: str) -> PreparedRecording | None:
    """Return the file that was made from this source; None if there is none."""
    try:
        with EventFile(job.target) as events:
            head, size = events.head, job.target.stat().st_size
            of = len(events.pictures_table), len(events.flows)
    except (VideoError, OSError):
        return None
    return PreparedRecording(job.id, size, head.events, *of, head.notes, is_kept=True) if head.source == name else None


def summary(converted: Iterable[PreparedRecording], destination: os.PathLike[str] | str) -> list[str]:
    """Return lines that state what was made, and what failed and why."""
    done = list(converted)
    made = [each for each in done if not each.problem]
    lines = [f"{len(made)} of {len(done)} recordings prepared ({sum(each.is_kept for each in made)} of them earlier)"]
    for each in made:
        parts = [f"{each.events:,} events", f"{each.pictures} pictures", f"{each.flows} fields of flow"]
        lines.append(f"  {each.id}: {', '.join(parts)}, {each.bytes / 1e6:.1f} MB")
        lines += [f"    {note}" for note in each.notes]
    lines += [f"  {each.id}: {each.problem}" for each in done if each.problem]
    if made:
        lines.append(f"serve them with v2v-serve --videos {destination} --videos-kind recordings --preset recordings")
    return lines
