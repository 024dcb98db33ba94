"""Several samples of one decode, for real: the same bytes as alone, fewer decodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_tools.remake import remake

BATCH, VIEWS = 3, 3


def dataset(address: str, batch_size: int = BATCH, **options: object) -> V2VStreamDataset:
    return V2VStreamDataset(
        address,
        batch_size=batch_size,
        recipe=SMALL,
        seed=3,
        samples_per_decode=VIEWS,
        **options,  # type: ignore[arg-type]
    )


def achieved(batches: list[Batch]) -> float:
    """Samples of one decode. A worker that joins late, or a second lease of a slow sample, costs a few more decodes."""
    return sum(map(len, batches)) / sum(batch.decodes for batch in batches)


@pytest.fixture(scope="module")
def batches(server: LocalServer) -> list[Batch]:
    """Of one epoch."""
    return list(dataset(server.address))


def test_samples_are_those_that_are_made_alone(clips: Path, batches: list[Batch]) -> None:
    spec = StreamSpec(recipe=SMALL, samples_per_decode=VIEWS, sibling_spacing=BATCH)
    assert len(batches) == 25 // BATCH * VIEWS
    assert achieved(batches) > VIEWS - 1
    catalogue = open_catalogue(clips)
    for batch in batches[1:5]:
        for row, index in enumerate(batch.indices):
            alone = remake(catalogue, spec, seed=3, epoch=0, index=index)
            np.testing.assert_array_equal(batch.voxels[row].numpy(), alone.arrays["voxels"])
            np.testing.assert_array_equal(batch.frames[row].numpy(), alone.arrays["frames"])
            assert batch.provenance[row] == alone.provenance


def test_no_batch_holds_two_of_a_sequence_and_their_cameras_differ(batches: list[Batch]) -> None:
    places = [{(item.video, item.start_frame) for item in batch.provenance} for batch in batches]
    assert all(len(each) == BATCH for each in places)
    assert places[0] == places[1] == places[2] != places[3]
    cameras = {(item.params.threshold_pos, item.params.noise_key) for batch in batches for item in batch.provenance}
    assert len(cameras) == len(batches) * BATCH


def test_a_stream_goes_on_with_a_smaller_batch_and_not_with_a_larger_one(
    server: LocalServer, batches: list[Batch]
) -> None:
    state = batches[2].resume_state
    smaller = dataset(server.address, batch_size=1)
    smaller.load_state_dict(state)
    rows = [batch.voxels[0].numpy() for batch in smaller]
    np.testing.assert_array_equal(np.stack(rows), np.concatenate([batch.voxels.numpy() for batch in batches[3:]]))
    larger = dataset(server.address, batch_size=4)
    larger.load_state_dict(state)
    with pytest.raises(UsageError, match="sibling_spacing = 3: samples of one decode would come in one global batch"):
        next(iter(larger))


def test_loader_workers_get_whole_families(server: LocalServer) -> None:
    loaded: list[Batch] = list(DataLoader(dataset(server.address), batch_size=None, num_workers=2))
    assert {index for batch in loaded for index in batch.indices} == set(range(25 // (2 * BATCH) * 2 * BATCH * VIEWS))
    assert achieved(loaded) > VIEWS - 1


def test_a_spacing_that_separates_siblings_is_told(server: LocalServer) -> None:
    with pytest.warns(UserWarning, match="samples of one decode go to different ranks or loader workers"):
        batches = list(dataset(server.address, sibling_spacing=BATCH + 1, rank=0, world_size=1))
    indices = [index for batch in batches for index in batch.indices]
    assert indices == list(range(25 // (BATCH + 1) * (BATCH + 1) * VIEWS // BATCH * BATCH))
