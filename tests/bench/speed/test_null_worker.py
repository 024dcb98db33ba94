"""Null workers: the server and its consumers cannot tell them from others by what they send."""

from __future__ import annotations

import numpy as np
import pytest

from bench.processes import consume, peak_rss_bytes
from bench.speed.null_workers import answer, null_service
from tests.bench.small import FLAGS, RECIPE
from tests.server.named_corpus import SMALL_SPEC, corpus, video
from v2v_client import V2VStreamDataset
from v2v_protocol.messages import decode_map, decode_sample
from v2v_protocol.sample import DEFAULT_ARRAYS, Form, Provenance, SampleId, array_layout
from v2v_server.broker.dispatcher import check_result
from v2v_server.broker.leases import Request
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


@pytest.mark.slow
def test_a_stream_of_null_workers_is_complete_and_in_order() -> None:
    with null_service(RECIPE, workers=3, sequences=20, flags=FLAGS) as service:
        dataset = V2VStreamDataset(service.server.address, batch_size=4, rank=0, world_size=1)
        batches = list(dataset)
        assert [index for batch in batches for index in batch.indices] == list(range(20))
        assert {item.decoder for batch in batches for item in batch.provenance} == {"none"}
        done = consume(dataset, service.roles, seconds=0.01, warmup_batches=6)
        assert done["batches"] >= 1
        assert done["bytes"] == done["batches"] * batches[0].nbytes
        roles = {key.removesuffix("_cpu_seconds_per_batch") for key in done if key.endswith("_cpu_seconds_per_batch")}
        assert roles == {"workers", "broker", "client"}
        assert peak_rss_bytes(service.server.pid) > 10_000_000
