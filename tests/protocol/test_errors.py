"""Errors cross process borders (survey processes, loader workers): they must survive pickling."""

from __future__ import annotations

import pickle

import pytest

from v2v_protocol.errors import RemoteError, SampleUnavailable, V2VError, VideoChanged, VideoError


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
