"""What a lease says of sidecars is checked, and a malformed sidecar ends no worker."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tests.protocol.persisted_values import example
from v2v_protocol import sample
from v2v_protocol.errors import ProtocolError, SidecarError, VideoError
from v2v_protocol.messages import Lease, LeaseFailed, WorkerHello, decode, encode
from v2v_protocol.sample import FromSidecar
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.source import sidecar_fingerprint
from v2v_server.worker import produce as reading
from v2v_server.worker.conversation import Make, Readiness, Send, WorkerConversation
from v2v_server.worker.produce import errors_of_sidecar, open_sidecars, refused_sidecars, sidecar_files

ENDING = ".label.json"


@pytest.fixture(autouse=True)
def _array(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sample.ARRAYS, "label", FromSidecar(ENDING, lambda recipe, _: ("float32", (1,))))


def lease(**changes: object) -> Lease:
    plain = {"video": "deep/a.mp4", "arrays": ("frames", "label"), "sidecars": {}}
    return dataclasses.replace(example(Lease), **plain | changes)  # type: ignore[arg-type]


def test_only_the_sidecars_of_asked_arrays_are_opened(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "a.label.json"
    file.parent.mkdir()
    file.write_text("[1]")
    mark = sidecar_fingerprint(file)
    known = lease(sidecars={ENDING: mark, ".other": "3-x"})
    assert sidecar_files(known) == {ENDING: ("deep/a.label.json", mark)}
    assert sidecar_files(lease(arrays=("frames",), sidecars={ENDING: mark})) == {}
    with open_sidecars(known, Folder(tmp_path)) as opened:
        assert opened == {ENDING: file}
    with open_sidecars(lease(), Folder(tmp_path)) as opened:
        assert opened == {ENDING: None}
    for text, reason in (("[2]", "changed since it was catalogued"), (None, "there is no such sidecar")):
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(SidecarError, match=reason) as raised, open_sidecars(known, Folder(tmp_path)):
            pass
        assert (raised.value.video, raised.value.ending, raised.value.here) == ("deep/a.mp4", ENDING, True)


def test_a_malformed_lease_is_refused() -> None:
    with pytest.raises(ProtocolError, match=r"fingerprint 7 of the sidecar \.label\.json"):
        sidecar_files(lease(sidecars={ENDING: 7}))


def test_any_error_over_a_sidecar_is_the_sidecars(tmp_path: Path) -> None:
    opened = {ENDING: tmp_path}
    text = r"^a\.mp4: its sidecar \.label\.json: KeyError: 'boxes'$"
    with pytest.raises(SidecarError, match=text) as raised, errors_of_sidecar("a.mp4", "label", opened):
        raise KeyError("boxes")
    assert not raised.value.here
    with pytest.raises(VideoError), errors_of_sidecar("a.mp4", "label", opened):
        raise VideoError("a.mp4", 3, "is damaged")
    for array, sidecars in (("frames", opened), ("label", {ENDING: None})):
        with pytest.raises(KeyError), errors_of_sidecar("a.mp4", array, sidecars):
            raise KeyError("a fault of the program")


def test_the_worker_reports_the_sidecar_and_not_the_video() -> None:
    talk = WorkerConversation(WorkerHello("w", 1, 2), "ipc://x", is_watched=True)
    talk.start(0.0)
    talk.on_messages([encode(lease(lease=5))[0]], 0.0)
    assert isinstance(talk.on_inspected(Readiness(True, True, False), 0.0)[-1], Make)
    (said, *_) = talk.on_failure(SidecarError("a.mp4", ENDING, "has no frame 3", here=True), 1.0)
    assert isinstance(said, Send)
    assert decode(said.frames[0]) == LeaseFailed(5, None, "has no frame 3", True, ENDING)


def test_a_sidecar_that_the_catalogue_refuses_is_not_opened(tmp_path: Path) -> None:
    refused = lease(sidecars={ENDING: ["3-abc", "has labels of frame 9"]})
    assert sidecar_files(refused) == {}
    assert refused_sidecars(refused) == {ENDING: "has labels of frame 9"}
    with open_sidecars(refused, Folder(tmp_path)) as opened:
        assert opened == {ENDING: None}
    with (
        pytest.raises(SidecarError, match=r"^a\.mp4: its sidecar \.label\.json: has labels of frame 9$") as raised,
        errors_of_sidecar("a.mp4", "label", opened, refused_sidecars(refused)),
    ):
        pytest.fail("the array is made")
    assert not raised.value.here
    assert decode(encode(refused)[0]) == refused
    for malformed in ([1, b""], ["3-abc", 7], ["3-abc"], {}):
        with pytest.raises(ProtocolError, match="fingerprint"):
            sidecar_files(lease(sidecars={ENDING: malformed}))


def test_memory_that_labels_take_is_their_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = {ENDING: tmp_path}
    with pytest.raises(SidecarError, match="MemoryError") as raised, errors_of_sidecar("a.mp4", "label", opened):
        raise MemoryError
    assert not raised.value.here

    def short(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(reading, "open_sidecar", short)
    with (
        pytest.raises(SidecarError, match="too much memory"),
        open_sidecars(lease(sidecars={ENDING: "3-abc"}), Folder(tmp_path)),
    ):
        pass
