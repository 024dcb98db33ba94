"""The table of digests (``tests/digests``), from a server with a cache that shares its samples."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.digests.clips import write_clips
from tests.digests.make import TABLE, Table
from tests.digests.rows import PORTABLE, ROWS, SIZE, compared, made
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.kinds.registry import VIDEOS
from v2v_server.status.client import StatusClient


@pytest.mark.slow
def test_a_server_that_shares_makes_the_bytes_of_the_table(tmp_path: Path) -> None:
    """Two consumers in step: each sample is made once."""
    flags = ["--rows", str(ROWS), "--share-gib", "0.01", "--scene", "auto", "--cache", str(tmp_path / "cache")]
    flags += [f"--set={name}={value}" for name, value in SIZE.items()]
    videos, table = tmp_path / "videos", Table(TABLE)
    rows = {name: row for name, row in PORTABLE.items() if row.kind == VIDEOS.name}
    videos.mkdir()
    write_clips(videos)
    with LocalServer(videos, workers=2, flags=flags) as server:
        for name, row in rows.items():
            datasets = [
                V2VStreamDataset(
                    server.address, 1, row.arrays, seed=row.seed, labels="optional", shared_memory=shared,
                    **_fields(row.stream),
                )
                for shared in (True, False)
            ]  # fmt: skip
            expected = table.row(name)
            for dataset in datasets:
                dataset.set_epoch(row.epoch)
            iterators = [iter(dataset) for dataset in datasets]
            got: list[list[Sample]] = [[], []]
            for _ in range(row.count):
                for samples, batches in zip(got, iterators, strict=True):
                    samples.append(_sample(next(batches)))
            for dataset in datasets:
                dataset.close()
            for samples in got:
                differences = compared(expected, made(samples))
                assert not differences, f"{name}, from a server: {'; '.join(differences)}"
        with StatusClient(server.address) as client:
            totals = client.get_status()["totals"]
    assert totals["shared"] >= sum(row.count for row in rows.values())


def _fields(spec: StreamSpec) -> dict[str, object]:
    return {name: getattr(spec, name) for name in StreamSpec.__dataclass_fields__}


def _sample(batch: Batch) -> Sample:
    arrays = {name: batch.arrays[name][0].numpy().copy() for name in batch.arrays}
    return Sample(arrays, batch.provenance[0])
