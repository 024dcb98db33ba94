"""Every exception that this project raises on purpose, and the party at fault.

    V2VError
    |-- UsageError               the caller: an argument, a flag, a configuration file
    |   |-- RecipeError              a recipe key, value or preset
    |   |-- KeyRefused               a key: missing, readable by others, revoked, or of another side or server
    |   |-- CorpusError              a folder, list file or index that gives no sequence
    |   |   `-- IndexUnreadable          the catalogue's index cannot be read now; no video is at fault
    |   `-- StateMismatch            a saved position that belongs to another stream
    |-- VideoError               the file: it cannot deliver what was catalogued (path, frame, reason)
    |   |-- VideoChanged             it is not the file that was catalogued
    |   `-- VideoUnreadable          this host cannot read it, whatever its content
    |       |-- VideoGone                    there is no such file
    |       `-- VideoDenied                  this user may not read it
    |-- SidecarError             a file beside a video, such as its labels (path, ending, reason)
    |-- ProtocolError            the peer: it sent something outside the protocol
    |   |-- VersionMismatch          another protocol or numerics version
    |   `-- LimitExceeded            a message, a list or a credit larger than stated
    |-- RemoteError              the server refused a request (code, text)
    |   `-- SampleUnavailable        one sample could not be made from any of its candidates
    |-- ServerLost               no known party: the server did not answer within the deadline
    |   `-- NoWorkers                the server answers, but no worker can make a sample
    `-- WorkerCrashLoop          the workers die without finishing anything

RepeatedSamplesWarning is a warning: the call works, but is rarely what the user intends.

A message states what is wrong with the value, the limit, and what to do, in this order.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class RepeatedSamplesWarning(UserWarning):
    """An iteration was left early, and the next one delivers the same samples again."""


class V2VError(Exception):
    """Base class of every exception that the project raises on purpose.

    Attributes:
        is_reported: whether a command has already written it to its log, so that it is not printed again.
    """

    is_reported = False


class UsageError(V2VError):
    """The caller gave an invalid argument, flag or configuration file."""


class RecipeError(UsageError):
    """A recipe names an unknown key or recipe, or a value outside its limits."""


class KeyRefused(UsageError):
    """A key is not accepted: missing, readable by others, revoked, or of another side or server."""


class CorpusError(UsageError):
    """A folder, list file or catalogue index cannot be used: missing, empty, or without any usable sequence."""


class IndexUnreadable(CorpusError):
    """The catalogue's index cannot be read now: another process holds it, or its storage fails. No video is at
    fault.
    """


class StateMismatch(UsageError):
    """A saved position belongs to another stream; the message names both sides."""


class VideoError(V2VError):
    """A video file cannot deliver what was catalogued.

    Attributes:
        video: the path or catalogue id of the file.
        frame: the first frame number (presentation order, from 0) that is not available; None if no single frame is to
            blame (the file does not open).
        reason: one line of text.
    """

    def __init__(self, video: str, frame: int | None, reason: str) -> None:
        self.video = video
        self.frame = frame
        self.reason = reason
        where = "" if frame is None else f" at frame {frame}"
        super().__init__(f"{video}{where}: {reason}")

    def __reduce__(self) -> tuple[type[VideoError], tuple[str, int | None, str]]:
        # The default would pass the finished message to a three-argument __init__.
        return type(self), (self.video, self.frame, self.reason)


class VideoChanged(VideoError):
    """The file differs from the one that was catalogued."""


class VideoUnreadable(VideoError):
    """This host could not read the file: it is missing, or its storage failed. This does not depend on the file's
    bytes.
    """


class VideoGone(VideoUnreadable):
    """There is no such file."""


class VideoDenied(VideoUnreadable):
    """This user may not read the file."""


class SidecarError(V2VError):
    """A file or folder beside a video, which an array is made from, cannot be used. The video is not at fault.

    Attributes:
        video: catalogue id of the video.
        ending: of the sidecar, see ``v2v_protocol.sample.FromSidecar``.
        reason: one line of text.
        here: this host cannot read the file, or has another one in its place; it may be sound elsewhere.
    """

    def __init__(self, video: str, ending: str, reason: str, here: bool = False) -> None:
        self.video, self.ending, self.reason, self.here = video, ending, reason, here
        super().__init__(f"{video}: its sidecar {ending}: {reason}")

    def __reduce__(self) -> tuple[type[SidecarError], tuple[str, str, str, bool]]:
        return type(self), (self.video, self.ending, self.reason, self.here)


class ProtocolError(V2VError):
    """The peer sent something outside the protocol."""


class VersionMismatch(ProtocolError):
    """The peer speaks another version; the message names both."""


class LimitExceeded(ProtocolError):
    """A message, list or credit is larger than the stated limit."""


class RemoteError(V2VError):
    """The server refused a request.

    Attributes:
        code: a short stable word, see ``v2v_protocol.messages.ErrorCode``; "unknown" if a message has none.
        text: the server's explanation.
    """

    def __init__(self, code: str, text: str | None = None) -> None:
        if text is None:
            # PyTorch rebuilds an exception of a loader worker from one text: the worker's traceback, which ends with
            # the message.
            text, code = _taken_apart(code)
        self.code = code
        self.text = text
        super().__init__(f"{text} [{code}]")

    def __reduce__(self) -> tuple[type[RemoteError], tuple[str, str]]:
        return type(self), (self.code, self.text)


def _taken_apart(message: str) -> tuple[str, str]:
    """Split the message of a :class:`RemoteError` into text and code; text around it is kept as text."""
    found = list(re.finditer(r" \[([a-z-]+)\]$", message, re.MULTILINE))
    if not found:
        return message, "unknown"
    return (message[: found[-1].start()] + message[found[-1].end() :]).rstrip(), found[-1][1]


class SampleUnavailable(RemoteError):
    """No candidate video of one sample could be used (or the spec says ``on_bad_video: raise``)."""


class ServerLost(V2VError):
    """The server did not answer within the deadline; the message names address and last sample."""


class NoWorkers(ServerLost):
    """The server answers, but no worker could make a sample within the deadline; the message says why."""


class WorkerCrashLoop(V2VError):
    """Server workers died again and again without finishing a single sample."""


@contextmanager
def system_errors(kind: Callable[[str], V2VError], what: str) -> Iterator[None]:
    """Turn an error of the system into one of this kind, until the end of the context.

    Args:
        kind: makes an error of its text.
        what: what failed; the system's reason follows.

    Raises:
        V2VError: of this kind.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror or error}") from error


@contextmanager
def undo_on_error(undo: Callable[[], object]) -> Iterator[None]:
    """Call a function if an error of any kind ends the context."""
    try:
        yield
    except BaseException:
        undo()
        raise
