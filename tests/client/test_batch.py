"""Test batches: access to their tensors, and copies to a device."""

from __future__ import annotations

import dataclasses
from collections import abc
from typing import Any

import pytest
import torch

from tests.protocol.test_sample import PROVENANCE
from v2v_client import Batch
from v2v_client.options import require_labels
from v2v_protocol.errors import SampleUnavailable, UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import ARRAYS, Provenance


class Somewhere:
    """Stand in for a tensor of which only the device matters."""

    def __init__(self, device: str, *, pinned: bool) -> None:
        self.device = torch.device(device)
        self.pinned = pinned
        self.moves: list[tuple[str, bool]] = []

    def is_pinned(self) -> bool:
        return self.pinned

    def to(self, device: str, non_blocking: bool) -> Somewhere:
        self.moves.append((device, non_blocking))
        return self


def of(voxels: Any) -> Batch:
    return with_arrays(voxels=voxels)


def with_arrays(**arrays: Any) -> Batch:
    return Batch(
        arrays=arrays, indices=(0,), epoch=0, provenance=(), resume_state={}, wait_seconds=0.0,
        cpu_seconds=0.0, decodes=1, recipe=Recipe(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("device", "pinned", "returns_early"), [("cpu", False, False), ("cpu", True, True), ("cuda:1", False, True)]
)
def test_only_pinned_memory_is_copied_asynchronously(device: str, pinned: bool, returns_early: bool) -> None:
    """Other memory may be written to by other processes as soon as the batch is dropped."""
    voxels = Somewhere(device, pinned=pinned)
    of(voxels).to("cuda:0", non_blocking=True)
    of(voxels).to("cuda:0")
    assert voxels.moves == [("cuda:0", returns_early), ("cuda:0", False)]


def test_a_batch_gives_tensors_by_name_but_is_not_a_mapping() -> None:
    """Frameworks rebuild mappings and count the items of iterables, but must pass on a Batch unchanged."""
    batch = of(torch.ones(1, 2))
    assert batch["voxels"] is batch.voxels
    assert dict(batch) == dict(batch.arrays)
    assert (lambda **tensors: set(tensors))(**batch) == set(batch.arrays)
    with pytest.raises(KeyError, match="this batch has"):
        batch["depth"]
    assert not isinstance(batch, abc.Mapping | abc.Iterable)
    with pytest.raises(TypeError, match="not iterable"):
        iter(batch)


@pytest.mark.parametrize("name", ARRAYS)
def test_every_array_is_an_attribute_and_says_how_to_get_it(name: str) -> None:
    with pytest.raises(UsageError, match=rf"batch.{name}: .*arrays=\('depth', '{name}'\)"):
        getattr(with_arrays(depth=torch.ones(1)), name)
    tensor = torch.ones(1, 2)
    if name != "boxes":  # a list for each clip
        assert getattr(with_arrays(**{name: tensor}), name) is tensor


def test_boxes_are_those_of_each_frame() -> None:
    boxes = torch.full((2, 3, 4, 7), -1.0)
    boxes[0, 1, :2, 4] = torch.tensor([5.0, 0.0])
    boxes[1, 2, :4, 4] = 1.0
    batch = with_arrays(boxes=boxes)
    assert [[len(frame) for frame in clip] for clip in batch.boxes] == [[0, 2, 0], [0, 0, 4]]
    assert torch.equal(batch.boxes[0][1], boxes[0, 1, :2])
    assert batch.boxes[0][1].untyped_storage().data_ptr() == boxes.untyped_storage().data_ptr(), "no copy"


def test_a_sample_without_its_labels_says_so() -> None:
    why = "tree/clip.mp4: its sidecar .boxes.txt: line 3 has 2 values"
    bare = dataclasses.replace(PROVENANCE, unlabelled={"boxes": why})
    batch = dataclasses.replace(of(torch.ones(2)), provenance=(PROVENANCE, bare))
    assert batch.labelled == (True, False)
    assert Provenance.from_dict(bare.to_dict()) == bare
    assert "unlabelled" not in PROVENANCE.to_dict()
    require_labels([PROVENANCE])
    with pytest.raises(SampleUnavailable, match=r'has no boxes: tree/clip\.mp4: .* line 3 .* labels="optional"'):
        require_labels(batch.provenance)
