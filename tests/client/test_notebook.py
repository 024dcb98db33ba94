"""Test how a notebook displays batches, samples, provenance and datasets."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader, Subset

from tests.clips import panned_luma, write_clip
from v2v_client import UsageError, V2VDataset, V2VStreamDataset
from v2v_client.batch import draw_samples
from v2v_pictures.colours import BRIGHTER
from v2v_server.simulation import simulate

RECIPE = {"preset": "noise-free", "voxels_per_clip": 4, "crop_height_px": 48, "crop_width_px": 48}
NAME = "<img src=x>&.mp4"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> V2VDataset:
    folder = tmp_path_factory.mktemp("look")
    write_clip(folder / NAME, panned_luma(60, 64, 80, step=(1, 2)))
    return V2VDataset(folder, RECIPE, cache_dir=str(folder / "cache"))


def test_a_batch_shows_itself_as_text_table_and_picture(dataset: V2VDataset) -> None:
    batch = next(iter(DataLoader(dataset, batch_size=1)))
    assert batch._repr_png_().startswith(b"\x89PNG")
    assert "data:image/png;base64," in batch._repr_html_()
    assert batch.show().width == dataset.show(0).width > 500
    assert batch.recipe == dataset.spec.recipe
    alone = dataclasses.replace(batch, arrays={"voxels": batch.voxels})
    assert alone._repr_png_() is None
    assert "<img" not in alone._repr_html_()
    with pytest.raises(UsageError, match="voxels,frames"):
        alone.show()


def test_a_sample_shows_itself_as_text_table_and_picture(dataset: V2VDataset, tmp_path: Path) -> None:
    sample = dataset[0]
    assert repr(sample).startswith("Sample(voxels: int8[4, 5, 48, 48], ")
    assert sample._repr_png_().startswith(b"\x89PNG")
    assert "data:image/png;base64," in sample._repr_html_()
    image = np.asarray(sample.show(tmp_path / "a.png"))
    assert np.ptp(image) == 255
    assert np.array_equal(np.asarray(dataset.show(0, tmp_path / "b.png")), image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    alone = dataclasses.replace(sample, arrays={"voxels": sample.arrays["voxels"]})
    assert alone._repr_png_() is None
    assert "drawn: threshold_pos" in alone._repr_html_()
    assert pickle.loads(pickle.dumps(sample)).title == sample.title


def test_a_sample_and_a_batch_name_their_arrays_alike(dataset: V2VDataset) -> None:
    sample, batch = dataset[np.int64(0)], next(iter(DataLoader(Subset(dataset, np.array([0])), batch_size=1)))
    for each in (sample, batch):
        assert dict(each.items()).keys() == dict(each).keys() == {*each.keys()} == {"voxels", "frames"}
        assert each.voxels is each["voxels"] is each.arrays["voxels"]
        assert "voxels" in each
        assert "flow" not in each
        with pytest.raises(UsageError, match="has only voxels, frames; create the dataset with arrays="):
            _ = each.flow
        with pytest.raises(AttributeError, match=r"did you mean 'voxels'"):
            _ = each.voxel
        with pytest.raises(KeyError, match="has voxels, frames; index it by one of these names"):
            _ = each[0]
        with pytest.raises(AttributeError, match=r"voxels = \.\.\.: a (batch|sample) cannot be changed; .* dict"):
            each.voxels = 1
        with pytest.raises(
            AttributeError, match=r"has no 'cuda'; (write .to\(\"cuda\"\)|its arrays are NumPy's: torch)"
        ):
            each.cuda()
    assert np.array_equal(batch.voxels[0], sample.voxels)


def test_a_batch_is_converted_and_moved(dataset: V2VDataset) -> None:
    batch = next(iter(DataLoader(dataset, batch_size=1)))
    for made in (batch.to(torch.float16), batch.to("cpu", torch.float16), batch.to("cpu", dtype=torch.float16)):
        assert {tensor.dtype for _, tensor in made.items()} == {torch.float16}
        assert torch.equal(made.voxels.to(torch.int8), batch.voxels)
    assert batch.to("cpu", non_blocking=True).voxels.dtype == torch.int8
    with pytest.raises(UsageError, match=r"batch.to\('cpu', True\): .* non_blocking=True by its name"):
        batch.to("cpu", True)


def test_an_argument_is_not_assigned(dataset: V2VDataset) -> None:
    stream = V2VStreamDataset("tcp://127.0.0.1:9", seed=np.int64(7), rank=np.int8(1), world_size=torch.tensor(2))
    assert (stream.seed, stream.rank, stream.world_size) == (7, 1, 2)
    mixture = V2VStreamDataset.mix({stream: np.float32(1)}, seed=np.int64(3))
    assert mixture.seed == 3
    for each, names in {
        dataset: ("seed", "epoch", "recipe", "videos", "rows"),
        stream: ("seed", "epoch", "rank", "batch_size", "arrays", "shuffle"),
        mixture: ("seed", "epoch", "weights"),
    }.items():
        for name in names:
            remedy = "call set_epoch" if name == "epoch" else f"create another one with {name}=..."
            with pytest.raises(AttributeError, match=rf"dataset.{name} = 3: it is fixed .*; {remedy}"):
                setattr(each, name, 3)
        each.note = "a name of the user's"


@pytest.mark.parametrize(
    "index", ["0", None, 0.0, True, slice(0, 2), [0, 1], np.array([0, 1]), torch.tensor(0.0)], ids=repr
)
def test_an_index_is_one_whole_number(index: Any, dataset: V2VDataset) -> None:
    with pytest.raises(UsageError, match="give one whole number"):
        dataset[index]


def test_a_simulated_result_shows_itself(tmp_path: Path) -> None:
    result = simulate(panned_luma(31, 40, 50), threshold_pos=0.2)
    assert repr(result) == "Voxels(int8[6, 5, 40, 50], 0 bins saturated)"
    image = result.show(tmp_path / "b.png")
    assert (np.asarray(image) == BRIGHTER).all(axis=-1).any()
    assert np.array_equal(np.asarray(Image.open(tmp_path / "b.png")), np.asarray(image))
    assert result._repr_png_() == (tmp_path / "b.png").read_bytes()
    assert "data:image/png;base64," in result._repr_html_()
    few = simulate(panned_luma(2, 8, 8), threshold_pos=0.2, bins=1)
    assert few.show().height < image.height


def test_file_names_are_escaped_in_html(dataset: V2VDataset) -> None:
    sample = dataset[0]
    for shown in (sample._repr_html_(), sample.provenance._repr_html_()):
        assert "<img src=x" not in shown
        assert "&lt;img src=x&gt;&amp;.mp4" in shown
        assert "drawn: threshold_pos" in shown


def test_texts_are_short(dataset: V2VDataset) -> None:
    stream = V2VStreamDataset("tcp://127.0.0.1:1", 3, rank=1, world_size=2)
    assert repr(stream) == "V2VStreamDataset('tcp://127.0.0.1:1', batch_size 3, seed 0, rank 1 of 2)"
    assert "1 of 2" in stream._repr_html_()
    assert "4 voxel grids of 5 bins, 48 x 48 px" in dataset._repr_html_()
    start = dataset[0].provenance.start_frame
    assert repr(dataset[0].provenance) == f"Provenance('{NAME}' from frame {start}, seed 0, epoch 0, index 0)"


def test_pauses_are_marked(dataset: V2VDataset) -> None:
    sample = dataset[0]
    params = dataclasses.replace(sample.provenance.params, pauses=((1, 4),))
    paused = dataclasses.replace(sample.provenance, params=params)
    drawn = [draw_samples([(sample.arrays, each)], dataset.spec.recipe, "T") for each in (sample.provenance, paused)]
    assert not np.array_equal(*drawn)


def test_grids_within_a_step_are_shown_and_found_at_their_frames(tmp_path: Path) -> None:
    write_clip(tmp_path / NAME, panned_luma(60, 64, 80, step=(1, 2)))
    recipe = RECIPE | {"grids_per_frame": 3, "bins": 2, "lead_frames": 1}
    arrays = ("event_counts", "voxels_bilinear", "frames")
    divided = V2VDataset(tmp_path, recipe, arrays=arrays, cache_dir=str(tmp_path / "cache"))
    batch = next(iter(DataLoader(divided, batch_size=1)))
    assert batch["event_counts"].shape == (1, 12, 2, 2, 48, 48)
    assert batch["voxels_bilinear"].shape == (1, 12, 2, 48, 48)
    assert divided.show(0).width > 500
    assert divided.spec.recipe.frame_grids == (-1, 2, 5, 8, 11)
    assert batch.frame_grids.tolist() == [-1, 2, 5, 8, 11]
