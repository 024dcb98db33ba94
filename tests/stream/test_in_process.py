"""V2VDataset: the stream's samples without a server."""

from __future__ import annotations

import multiprocessing
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL, digest, epoch_of
from v2v_client import Batch, UsageError, V2VDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import CorpusError


@pytest.fixture(scope="module")
def dataset(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> V2VDataset:
    return V2VDataset(clips, recipe=SMALL, seed=3, cache_dir=str(tmp_path_factory.mktemp("index")))


@pytest.fixture(scope="module")
def streamed(server: LocalServer) -> dict[int, dict[int, Batch]]:
    epochs = {epoch: epoch_of(server.address, epoch=epoch, batch_size=1) for epoch in (0, 1)}
    return {epoch: {batch.indices[0]: batch for batch in batches} for epoch, batches in epochs.items()}


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_sample_is_that_of_the_stream(
    dataset: V2VDataset, streamed: dict[int, dict[int, Batch]], data: st.DataObject
) -> None:
    dataset.set_epoch(data.draw(st.sampled_from((0, 1))))
    index = data.draw(st.integers(0, len(dataset) - 1))
    sample, batch = dataset[index], streamed[dataset.epoch][index]
    np.testing.assert_array_equal(sample.arrays["voxels"], batch.voxels[0].numpy())
    np.testing.assert_array_equal(sample.arrays["frames"], batch.frames[0].numpy())
    assert sample.provenance == batch.provenance[0]


def test_it_is_a_sequence(dataset: V2VDataset) -> None:
    dataset.set_epoch(0)
    assert dataset[-1].provenance.id.index == len(dataset) - 1
    for outside in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError, match=f"the epoch has {len(dataset)} samples"):
            dataset[outside]
    assert repr(dataset).endswith(f"{len(dataset)} samples, seed 3, epoch 0)")


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_a_data_loader_makes_batches_of_it(dataset: V2VDataset, server: LocalServer, context: str) -> None:
    if context not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {context}")
    dataset.set_epoch(1)
    loader = DataLoader(dataset, batch_size=3, num_workers=2, drop_last=True, multiprocessing_context=context)
    made = [digest(batch) for batch in loader]
    assert made == [digest(batch) for batch in epoch_of(server.address, epoch=1)]


def test_what_is_wrong_is_said(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="voxels_per_clip"):
        V2VDataset(clips, recipe={"voxels_per_clip": 0})
    with pytest.raises(UsageError, match="voxel_dtyp"):
        V2VDataset(clips, voxel_dtyp="int8")
    with pytest.raises(UsageError, match="seed = -1"):
        V2VDataset(clips, seed=-1)
    with pytest.raises(CorpusError, match="no video gives a sequence"):
        V2VDataset(clips, recipe={"voxels_per_clip": 1000}, cache_dir=str(tmp_path))
    monkeypatch.setitem(sys.modules, "v2v_server.offline.remake", None)
    with pytest.raises(UsageError, match=r"pip install '\.\[server\]'"):
        V2VDataset(clips, recipe=SMALL)
