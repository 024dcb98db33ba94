"""Admission: what a Hello is answered with, and which session comes of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.pieces import pieces
from tests.server.named_corpus import SMALL_SPEC, video
from tests.server.peers import peers
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.messages import Hello
from v2v_protocol.spec import StreamSpec
from v2v_server import corpus_words, lease_memory
from v2v_server.broker.admission import admit
from v2v_server.broker.state import Broker
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.scene import Flag
from v2v_server.corpus.videos import CorpusFacts, encoded_pieces
from v2v_server.quarantine import Quarantine, QuarantineEntry
from v2v_server.video.rows import Rows

SAMPLE_BYTES = 2 * 2 * 8 * 8
VERDICTS = [QuarantineEntry(number, "v0.mp4", "f", 0, "crash", "t") for number in (1, 2, 3)]


def admission(max_credit_bytes: int = 2**30, quarantine: Quarantine | None = None) -> Broker:
    return peers(None, SMALL_SPEC, max_credit_bytes, quarantine).broker


def hello(batch_size: int = 4, seed: int = 0, quarantine: int | None = None, **spec: Any) -> Hello:
    return Hello(spec, ("voxels",), batch_size, seed, quarantine)


def test_the_session_is_what_the_answer_says() -> None:
    session, welcome = admit(admission(quarantine=Quarantine(VERDICTS)), b"c", hello(12, 7, 2, shuffle=False), 5.0)
    spec = StreamSpec.from_dict(welcome.spec)
    assert (session.spec, spec.shuffle, spec.digest) == (spec, False, welcome.spec_digest)
    assert (session.identity, session.seed, session.arrays, session.batch_size) == (b"c", 7, ("voxels",), 12)
    assert (session.credit, session.quarantine, session.liveness.silence(7.0)) == (welcome.credit, 2, 2.0)
    assert (session.schedule.count, session.waiting, session.unanswered) == (
        welcome.sequences,
        type(session.waiting)(),
        set(),
    )
    assert (welcome.credit, welcome.quarantine, welcome.sequences) == (24, 2, 50)
    assert (welcome.catalogue_digest, welcome.numerics_version) == ("c" * 32, NUMERICS_VERSION)


@pytest.mark.parametrize(
    ("limit", "batch_size", "workers", "credit"),
    [(2**30, 12, 0, 24), (2**30, 12, 12, 24), (2**30, 12, 20, 40), (2**30, 1, 0, 2), (SAMPLE_BYTES, 12, 1, 1),
     (10 * SAMPLE_BYTES - 1, 12, 1, 9), (24 * SAMPLE_BYTES, 12, 1, 24)],
)  # fmt: skip
def test_credit_keeps_batches_and_workers_busy_within_its_bytes(
    limit: int, batch_size: int, workers: int, credit: int
) -> None:
    at = admission(limit)
    at.expected_workers = workers
    assert admit(at, b"c", hello(batch_size), 0.0)[0].credit == credit


def test_a_sample_that_the_credit_cannot_hold_is_refused() -> None:
    with pytest.raises(UsageError, match=f"one sample is {SAMPLE_BYTES} bytes; .* is {SAMPLE_BYTES - 1}: raise it"):
        admit(admission(SAMPLE_BYTES - 1), b"c", hello(), 0.0)


@pytest.mark.parametrize(("stride", "height"), [(1, 1100), (4, 1100), (4, 1000)])
def test_the_frames_that_a_camera_sees_are_limited(stride: int, height: int) -> None:
    """A small picture may be enlarged. What the stride leaves out is not held."""
    recipe = {"voxels_per_clip": 400, "bins": 5, "frame_stride": stride, "resize_scale": [64, 64],
              "crop_height_px": height, "crop_width_px": 1000}  # fmt: skip
    said = "the 2001 frames of 1000x1100 px .* are 2099 MiB; the limit is 2048" if height > 1000 else "none of the 5"
    with pytest.raises(UsageError, match=said):
        admit(admission(2**40), b"c", Hello({"recipe": recipe}, ("frames",), 1, 0), 0.0)


def test_the_quarantine_is_the_newest_unless_an_older_one_is_asked_for() -> None:
    at = admission(quarantine=Quarantine(VERDICTS))
    received = [admit(at, b"c", hello(quarantine=asked), 0.0) for asked in (None, 0, 1, 3)]
    assert [session.quarantine for session, _ in received] == [3, 0, 1, 3]
    assert [welcome.quarantine for _, welcome in received] == [3, 0, 1, 3]
    with pytest.raises(CorpusError, match=r"snapshot 4 was asked for, this server has 0 \.\. 3") as refused:
        admit(at, b"c", hello(quarantine=4), 0.0)
    # Perhaps the file is another one; perhaps another server has added to it since this one read it.
    for remedy in (
        "v2v-quarantine --videos DIR", "restart this server", 'set "quarantine" of the saved state to None',
    ):  # fmt: skip
        assert remedy in str(refused.value)


def test_how_many_share_a_decode_decides_what_a_worker_can_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two such specs shared a table: how many sequences there were depended on who had come first."""
    at = admission()
    for limited in (corpus_words, lease_memory):  # one sample takes 320
        monkeypatch.setattr(limited, "MOST_CLIP_BYTES", 400)
    admit(at, b"c", hello(), 0.0)
    with pytest.raises(UsageError, match="MiB of decoded frames"):
        admit(at, b"d", hello(samples_per_decode=2), 0.0)


def test_one_table_serves_all_specs_of_a_geometry() -> None:
    at = admission()
    of = [admit(at, b"c", each, 0.0)[0].schedule.table for each in (hello(), hello(shuffle=False, seed=3))]
    other = admit(at, b"c", hello(max_sequences_per_video=3), 0.0)[0].schedule.table
    assert of[0] is of[1]
    assert (other.count, of[0].count) == (15, 50)


@pytest.mark.parametrize("asked", [{"still_share": 1.0}, {"quiet_share": 0.0}, {"keep_defects": "black"}])
def test_the_sequences_of_a_spec_do_not_depend_on_who_came_before(asked: dict[str, Any]) -> None:
    parts = pieces((50, 0), (100, Flag.BLACK), (200, Flag.QUIET), (400, Flag.STILL | Flag.QUIET))
    entry = replace(video("v.mp4", 400), pieces=encoded_pieces(parts, 400))
    facts = CorpusFacts((entry,), Rows(), "c" * 32, "s" * 32)
    default, other = ({"scene": "auto", "max_sequences_per_video": 1000} | changed for changed in ({}, asked))

    def count(*specs: dict[str, Any]) -> int:
        at = peers(cast(Catalogue, SimpleNamespace(facts=facts))).broker
        return [admit(at, b"c", hello(**spec), 0.0)[1].sequences for spec in specs][-1]

    assert count(default, other) == count(other) != count(default)
