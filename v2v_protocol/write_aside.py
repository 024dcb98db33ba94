"""Write files so that their name holds either the old content or the complete new one, and never replace an input."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from v2v_protocol.errors import UsageError, system_errors

_LISTS = frozenset({".txt", ".csv", ".lst"})
"""Endings of files that may name the videos beside them."""
JSON = (".json",)
"""Endings of ``--json FILE``. Another name will do, unless a file of that name exists that is not JSON."""
_RESULTS = _LISTS | {"", ".json", ".yaml", ".yml", ".html", ".npz"}
"""Endings of files that no command finds in a folder of videos or recordings: their name has to be given."""
OUTPUT_MARKER = ".v2v-output"
"""File in a folder of outputs: a catalogue of videos passes over the folder."""
_STREAMS = frozenset({"/dev", "/dev/fd"})
"""Folders whose files, such as /dev/stdout, are written in place."""


@contextlib.contextmanager
def write_aside_and_rename(path: Path, *, partial: Path | None = None, durable: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces ``path`` at the end of the block.

    After an error, in the block or here, ``path`` is unchanged and the temporary file is removed. The target of a link
    is replaced, not the link. A pipe or a device is yielded itself.

    Args:
        path: the final name.
        partial: the temporary name, in the same folder; None uses a hidden name with this process's id.
        durable: whether to wait until the content and the name are on disk.

    Raises:
        OSError: the file cannot be flushed or renamed.
    """
    if is_stream(path):
        yield path
        return
    path = path.resolve()
    partial = partial or path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            flush(partial)
        partial.replace(path)
    finally:
        with contextlib.suppress(OSError):  # as the error that is under way says more
            partial.unlink()
    if durable:
        # The name is an entry of the folder: without this it can be lost although the content is not.
        with contextlib.suppress(PermissionError):  # a folder without the right to list it
            flush(path.parent)


def flush(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_file(path: Path, content: bytes | str, flag: str = "") -> None:
    """Write a file that a user asked for: all of it, or nothing.

    Args:
        flag: names the file in the message of an error.

    Raises:
        UsageError: it cannot be written.
    """
    named = f"{flag} {path}".lstrip()
    with system_errors(UsageError, f"{named}: cannot be written"), write_aside_and_rename(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def check_output(
    flag: str, path: Path, endings: Collection[str], inputs: Iterable[str | os.PathLike[str]] = ()
) -> None:
    """Check, before any work, that a command may write a file.

    It may not be one of the inputs under any name, or hold labels of a video. An existing file in a folder of inputs
    (or beside a list file) is also refused where other files of its ending lie beside it: it may be an input like them.
    So is a file in a folder of inputs that a later run may take for one of them.

    Args:
        flag: names the file in messages.
        endings: the endings that the command can write, in lower case.
        inputs: what the command reads; what does not exist is skipped.

    Raises:
        UsageError: it may not be written, or its folder is missing or write-protected.
    """
    named = f"{flag} {path}"
    try:
        if path.is_dir():
            raise UsageError(f"{named}: it is a folder; give the name of a file")
        if is_stream(path):
            return
        if path.suffix.lower() not in endings and (endings != JSON or _is_other_than_json(path)):
            raise UsageError(f"{named}: unknown ending; give a name that ends in {', '.join(endings)}")
        if not path.parent.is_dir():
            raise UsageError(f"{named}: there is no folder {path.parent}; create it first")
        locked = next((at for at in (path, path.parent) if at.exists() and not is_writable(at)), None)
        if locked is not None:
            raise UsageError(f"{named}: {locked} is write-protected; give another name, or allow writing")
        if why := _input_reason(path.resolve(), given := list(inputs)):
            raise UsageError(f"{named}: {why}; give another name")
        if path.suffix.lower() not in _RESULTS:
            check_outside(flag, path, given)
    except (OSError, ValueError) as error:  # too long a name, a NUL in it, a share that has gone
        raise UsageError(f"{named}: {getattr(error, 'strerror', None) or error}") from error


def check_outside(
    flag: str, output: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]], what: str = "outputs"
) -> None:
    """Check, before any work, that later runs will not take an output for one of their inputs.

    Args:
        flag: names the output in messages.
        output: file or folder to write; "" is none. A marked folder (:func:`make_output_folder`) may lie anywhere.
        inputs: what the command reads; only folders count.
        what: names the content of the output in messages.

    Raises:
        UsageError: it is an input folder, or lies in one.
    """
    path = Path(output).resolve()
    if not os.fspath(output) or (path / OUTPUT_MARKER).exists():
        return
    for given in filter(os.fspath, inputs):
        folder = Path(given).resolve()
        if folder.is_dir() and path.is_relative_to(folder):
            name = path.name if path != folder else f"{path.name}-{flag.lstrip('-')}"
            raise UsageError(
                f"{flag} {output}: it lies in {given}, which this command reads, so a later run would read its {what} "
                f"too; give a place outside, such as {os.path.relpath(folder.parent / name)}"
            )


def make_output_folder(folder: Path) -> None:
    """Create a folder, and mark it if it is empty. One that holds something may be the user's, and stays as it is.

    Raises:
        OSError: it cannot be created, listed or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        (folder / OUTPUT_MARKER).write_text("A v2v command wrote this folder; a catalogue of videos passes over it.\n")


def is_writable(path: Path) -> bool:
    """Return whether a file or folder can be written to."""
    # By the rights that writing will have, such as the capabilities of a user that is not root.
    return os.access(path, os.W_OK, effective_ids=os.access in os.supports_effective_ids)


def _input_reason(path: Path, inputs: Iterable[str | os.PathLike[str]]) -> str:
    """Return why a resolved path is an input; "" if it is none."""
    from v2v_protocol.sample import ARRAYS, sidecar_endings  # lazily: it loads NumPy, which --help does not need

    labels = sidecar_endings(tuple(ARRAYS))
    if path.name.endswith(labels) or any(f"{each.name}/".endswith(labels) for each in path.parents):
        return "it has the name of a video's labels"
    for given in filter(os.fspath, inputs):
        read = Path(given).resolve()
        if read == path or (path.exists() and read.exists() and read.samefile(path)):
            return f"it is {given}, which this command also reads or writes"
        folder = read.parent if read.suffix.lower() in _LISTS and read.is_file() else read
        if path.exists() and folder.is_dir() and path.is_relative_to(folder):
            alike = (each.name for each in path.parent.iterdir() if each.suffix.lower() == path.suffix.lower())
            if any(name != path.name for name in alike):
                return f"it exists, beside other {path.suffix} files, in {folder}, which this command reads"
    return ""


def _is_other_than_json(path: Path) -> bool:
    """Return whether there is such a file, with something in it that does not begin as JSON records do."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        return file.read(1) not in b"[{"


def is_stream(path: Path) -> bool:
    """Return whether a path is a pipe or device, which is written in place."""
    return os.fspath(path.parent) in _STREAMS or (path.exists() and not path.is_file() and not path.is_dir())


def write_json(file: str | os.PathLike[str], records: Sequence[Mapping[str, Any]]) -> None:
    """Write the records of a command's ``--json FILE``.

    Raises:
        UsageError: the file cannot be written.
    """
    write_file(Path(file), json.dumps(records, indent=1) + "\n", "--json")
