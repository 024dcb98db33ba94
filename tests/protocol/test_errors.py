"""Errors cross process borders (survey processes, loader workers): they must survive pickling."""

from __future__ import annotations

import errno
import os
import pickle
from functools import partial

import pytest

from v2v_protocol.errors import (
    CorpusError,
    RemoteError,
    SampleUnavailable,
    V2VError,
    VideoChanged,
    VideoError,
    system_errors,
    undo_on_error,
)


@pytest.mark.parametrize(
    "error",
    [
        VideoError("a.mp4", 3, "cut short"),
        VideoError("a.mp4", None, "does not open"),
        VideoChanged("a.mp4", None, "other size"),
        RemoteError("spec", "no such key"),
        SampleUnavailable("unavailable", "a.mp4: cut short"),
    ],
)
def test_errors_survive_pickling(error: V2VError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


@pytest.mark.parametrize(
    ("message", "text", "code"),
    [
        ("no video [spec]", "no video", "spec"),
        ("Trace:\n  a = b[c]\nError: no video [busy]\n", "Trace:\n  a = b[c]\nError: no video", "busy"),
        ("RemoteError: no video [spec]\nwith a note", "RemoteError: no video\nwith a note", "spec"),
        ("no video", "no video", "unknown"),
    ],
)
def test_a_refusal_is_read_from_its_message(message: str, text: str, code: str) -> None:
    error = RemoteError(message)
    assert (error.text, error.code, str(error)) == (text, code, f"{text} [{code}]")


def test_errors_of_the_system_alone_become_ours_and_keep_their_cause() -> None:
    with (
        pytest.raises(VideoError, match=r"^a\.mp4: cannot be read: No space left on device$") as caught,
        system_errors(partial(VideoError, "a.mp4", None), "cannot be read"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "b")
    assert isinstance(caught.value.__cause__, OSError)
    with pytest.raises(CorpusError, match=r"^x: not the system's words$"), system_errors(CorpusError, "x"):
        raise OSError("not the system's words")
    with pytest.raises(ValueError, match=r"^other$"), system_errors(CorpusError, "x"):
        raise ValueError("other")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no")])
def test_only_an_error_of_any_kind_is_undone(error: BaseException) -> None:
    undone = list[str]()
    with undo_on_error(lambda: undone.append("without")):
        pass
    with pytest.raises(type(error)) as caught, undo_on_error(lambda: undone.append("with")):
        raise error
    assert caught.value is error
    assert undone == ["with"]
