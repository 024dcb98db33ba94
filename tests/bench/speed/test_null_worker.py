"""Null workers: the server and its consumers cannot tell them from others by what they send."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.null_workers import answer
from tests.server.named_corpus import SMALL_SPEC, corpus, video
from v2v_protocol.messages import decode_map, decode_sample
from v2v_protocol.sample import DEFAULT_ARRAYS, Form, Provenance, SampleId, array_layout
from v2v_server.broker.leases import Request
from v2v_server.broker.workers import check_result
from v2v_server.schedule import Schedule, SequenceTable
from v2v_tools.remake import lease_for


@pytest.mark.parametrize("arrays", [DEFAULT_ARRAYS, ("frames",), ("voxels", "flow", "flow_valid")])
def test_an_answer_passes_every_check_of_server_and_client(arrays: tuple[str, ...]) -> None:
    catalogue = corpus(video("a.mp4"), video("b.mp4"))
    schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, SMALL_SPEC), SMALL_SPEC)
    request = Request(b"consumer", 3, 1, snapshot=2)
    lease = lease_for(
        request, number=7, sequence=schedule.candidate(5, 3, 1, 0), catalogue=catalogue, spec=SMALL_SPEC,
        seed=5, arrays=arrays,
    )  # fmt: skip
    frames = answer(lease, "null-1")
    layout = array_layout(SMALL_SPEC.recipe, SMALL_SPEC.voxel_dtype, arrays)
    header = check_result(frames, request, Form.of(layout))
    found = decode_sample(layout, frames[1:])
    assert {name: (array.dtype.name, array.shape) for name, array in found.items()} == layout
    assert all(np.all(array == 1) for array in found.values())
    provenance = Provenance.from_dict(decode_map(header.provenance))
    assert provenance.id == SampleId(SMALL_SPEC.digest, catalogue.digest, provenance.id.numerics_version, 5, 3, 1)
    assert (provenance.video, provenance.quarantine) == (lease.video, 2)
