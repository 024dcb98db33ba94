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
