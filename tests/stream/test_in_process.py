"""V2VDataset: the stream's samples without a server."""

from __future__ import annotations

import multiprocessing
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL, digest, epoch_of
from v2v_client import UsageError, V2VDataset, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import CorpusError
from v2v_protocol.programs import install_line


@pytest.fixture(scope="module")
def dataset(clips: Path) -> V2VDataset:
    return V2VDataset(clips, recipe=SMALL, seed=3)


def test_events_add_up_to_the_voxels(dataset: V2VDataset) -> None:
    sample, events = dataset[0], dataset.events(0)
    assert sample.provenance.saturated_bins == 0
    sums = np.zeros((events.height_px, events.width_px), int)
    np.add.at(sums, (events.y, events.x), np.where(events.p, 1, -1))
    np.testing.assert_array_equal(sums, sample.arrays["voxels"].astype(int).sum(axis=(0, 1)))
    assert len(events) > 0
    assert (np.diff(events.t) >= 0).all()
    with pytest.raises(IndexError, match="the epoch has"):
        dataset.events(len(dataset))


_RANGES = {
    "threshold": st.sampled_from(([0.1, 0.1], [0.2, 1.0])),
    "noise_sigma": st.sampled_from(([0, 0], [0.01, 0.05])),
    "pause_probability": st.sampled_from((0.0, 0.2)),
    "resize_scale": st.sampled_from(([1, 1], [0.8, 1.3])),
    "contrast_probability": st.sampled_from((0.0, 1.0)),
    "noise_unit": st.sampled_from(("frame", "second")),
    "leak_hz": st.sampled_from((0.0, [0.1, 1.0])),
    "threshold_mismatch_sigma": st.sampled_from((0.0, [0.0, 0.2])),
    "lead_frames": st.integers(0, 1),
    "frame_stride": st.integers(1, 2),
}


@pytest.mark.slow
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    shape=st.fixed_dictionaries(
        {"voxels_per_clip": st.integers(1, 4), "bins": st.integers(1, 5), "frames_per_bin": st.integers(1, 2)}
    ),
    fields=st.fixed_dictionaries({}, optional=_RANGES),
    side=st.integers(8, 36),
    flow=st.booleans(),
    dtype=st.sampled_from(("int8", "int16", "float32")),
    seed=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 1000),
)
def test_a_sample_of_any_recipe_is_that_of_the_stream(
    clips: Path, server: LocalServer, shape: dict[str, int], fields: dict[str, Any], side: int,
    flow: bool, dtype: str, seed: int, epoch: int,
) -> None:  # fmt: skip
    if dtype == "int16":  # the general kernel in int16 takes long to compile; test_times.py has it
        fields = {name: value for name, value in fields.items() if name not in ("leak_hz", "threshold_mismatch_sigma")}
    recipe = {"preset": "paper", **shape, **fields, "crop_height_px": side, "crop_width_px": side + 1}
    arrays = ("voxels", "frames", *(("flow", "flow_valid") if flow else ()))
    given_ = {"recipe": recipe, "arrays": arrays, "seed": seed, "epoch": epoch, "voxel_dtype": dtype}
    stream = iter(V2VStreamDataset(server.address, batch_size=2, **given_))
    batch = next(stream)
    del stream
    alone = V2VDataset(clips, **given_)
    for place, index in enumerate(batch.indices):
        sample = alone[index]
        assert sample.provenance == batch.provenance[place]
        for name in arrays:
            np.testing.assert_array_equal(sample.arrays[name], batch[name][place].numpy())


def test_it_is_a_sequence(dataset: V2VDataset) -> None:
    dataset.set_epoch(0)
    assert dataset[-1].provenance.id.index == len(dataset) - 1
    for outside in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError, match=f"the epoch has {len(dataset)} samples"):
            dataset[outside]
    assert repr(dataset).endswith(f"{len(dataset)} samples, seed 3, epoch 0)")


@pytest.mark.parametrize(("context", "workers"), [("fork", 2), ("spawn", 1)])
def test_a_data_loader_makes_batches_of_it(
    dataset: V2VDataset, server: LocalServer, context: str, workers: int
) -> None:
    if context not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {context}")
    dataset.set_epoch(1)
    loader = DataLoader(dataset, batch_size=3, num_workers=workers, drop_last=True, multiprocessing_context=context)
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
    monkeypatch.setitem(sys.modules, "v2v_tools.remake", None)
    with pytest.raises(UsageError, match=re.escape(install_line("server"))):
        V2VDataset(clips, recipe=SMALL)
