"""Weights of others: safe unpickling, names, strictness."""

from __future__ import annotations

import copy
import os
import pickle
import random
from collections import OrderedDict, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.trainer.training import same
from trainer.models import E2VID, FireNet
from trainer.unpickle import Placeholder, read_torch_file
from trainer.weights import load_into, load_network, read_weights
from v2v_protocol.errors import UsageError


class ConfigParser:
    """Stands for the class of that name in published checkpoints, which a reader does not have."""

    def __init__(self, unet_kwargs: dict[str, Any]) -> None:
        self._config = {"name": "run", "arch": {"type": "FlowNet", "args": {"unet_kwargs": unet_kwargs}}}
        self.loggers = defaultdict(list, {"a": [1, 2]})


class MakesFolder:
    """A pickle that makes a folder when it is read by a trusting reader."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.folder),)


class CallsGetattr:
    """A pickle that asks for an attribute, the first link of many exploits."""

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, ("text", "upper")


def small(seed: int = 0) -> E2VID:
    torch.manual_seed(seed)
    return E2VID(base_channels=2, encoders=2)


# reading without trust


@pytest.mark.parametrize("zipped", [True, False])
def test_nothing_in_a_file_is_executed(tmp_path: Path, zipped: bool) -> None:
    model, marker = small(), tmp_path / "marker"
    content = {"state_dict": model.state_dict(), "config": MakesFolder(marker)}
    torch.save(content, tmp_path / "trap.pth", _use_new_zipfile_serialization=zipped)
    state = read_weights(tmp_path / "trap.pth").state
    assert same(dict(state), model.state_dict())
    assert not marker.exists()
    with pytest.raises(FileNotFoundError):
        marker.rmdir()
    torch.load(tmp_path / "trap.pth", weights_only=False)
    assert marker.is_dir(), "the trap does not work, so the test shows nothing"


def test_calls_in_a_pickle_become_placeholders(tmp_path: Path) -> None:
    torch.save({"state_dict": {"a": torch.ones(2)}, "x": CallsGetattr()}, tmp_path / "chain.pth")
    assert isinstance(read_torch_file(tmp_path / "chain.pth")["x"], Placeholder)


@pytest.mark.parametrize("zipped", [True, False])
def test_pickled_objects_beside_the_weights_are_ignored(tmp_path: Path, zipped: bool) -> None:
    """As event_cnn_minimal and V2V save: optimiser and scheduler as objects, a ConfigParser."""
    model = small()
    optimizer = torch.optim.Adam(model.parameters(), amsgrad=True)
    model.forward_sequence(torch.ones(1, 1, 5, 16, 16)).mean().backward()
    optimizer.step()
    content = {
        "arch": "FlowNet",
        "epoch": 3,
        "state_dict": model.state_dict(),
        "optimizer": optimizer,
        "lr_scheduler": torch.optim.lr_scheduler.StepLR(optimizer, 1),
        "monitor_best": np.float64(0.5),
        "config": ConfigParser({"num_bins": 5, "norm": "none", "kernel_size": 5, "list": [1]}),
    }
    torch.save(content, tmp_path / "whole.pth", _use_new_zipfile_serialization=zipped)
    file = read_weights(tmp_path / "whole.pth")
    assert same(dict(file.state), model.state_dict())
    assert file.settings == {"num_bins": 5, "norm": "none", "kernel_size": 5, "padding": "centred"}


@pytest.mark.parametrize(
    ("content", "ema", "message"),
    [
        (None, False, "no file"),
        (b"", False, "not a PyTorch file"),
        (b"PK\x03\x04 and no more", False, "not a PyTorch file"),
        (pickle.dumps({"state_dict": 1}), False, "not a PyTorch file"),
        (random.Random(0).randbytes(100), False, "not a PyTorch file"),
        ({"epoch": 1, "losses": [1.0]}, False, "holds epoch, losses"),
        ({"state_dict": small().state_dict()}, True, "under 'ema'"),
        ({"a.weight": torch.zeros(1), "module.a.weight": torch.ones(1)}, False, "same name"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: Any, ema: bool, message: str) -> None:
    path = tmp_path / "file.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(UsageError, match=message):
        load_into(small(), path, ema=ema)


@pytest.mark.parametrize("zipped", [True, False])
def test_damaged_files_give_one_kind_of_error(tmp_path: Path, zipped: bool) -> None:
    """Bytes overwritten anywhere: weights of the right names and shapes, or a UsageError."""
    path, rng = tmp_path / "file.pth", np.random.default_rng(0)
    weights = {"state_dict": {"a": torch.ones(2, 3)}, "config": ConfigParser({"num_bins": 5})}
    torch.save(weights, path, _use_new_zipfile_serialization=zipped)
    whole, refused = path.read_bytes(), 0
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 4)):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_weights(path)
        except UsageError:
            refused += 1
    assert refused > 20


# names


@pytest.mark.parametrize("prefix", ["", "module.", "_orig_mod.", "module._orig_mod.", "_orig_mod.module."])
@pytest.mark.parametrize("container", ["bare", "state_dict", "model"])
def test_prefixes_of_wrappers_are_removed(tmp_path: Path, prefix: str, container: str) -> None:
    model = small()
    wrapped = OrderedDict((prefix + name, tensor) for name, tensor in model.state_dict().items())
    torch.save(wrapped if container == "bare" else {container: wrapped, "epoch": 1}, tmp_path / "wrapped.pth")
    other = small(seed=1)
    assert not same(other.state_dict(), model.state_dict())
    report = load_into(other, tmp_path / "wrapped.pth")
    assert same(other.state_dict(), model.state_dict())
    assert set(report.used) == set(model.state_dict())
    assert report.renamed == ({name: name.removeprefix(prefix) for name in wrapped} if prefix else {})


def test_e2vid_plus_gives_its_image_channel(tmp_path: Path) -> None:
    model = small()
    state = {name.replace("unetrecurrent.", "unetflow."): tensor for name, tensor in model.state_dict().items()}
    for kind in ("weight", "bias"):
        image = state[f"unetflow.pred.conv2d.{kind}"]
        state[f"unetflow.pred.conv2d.{kind}"] = torch.cat([image, image + 1, image + 2])
    torch.save({"state_dict": state, "config": ConfigParser({"num_bins": 5})}, tmp_path / "plus.pth")
    other = small(seed=1)
    report = load_into(other, tmp_path / "plus.pth")
    assert same(other.state_dict(), model.state_dict())
    assert report.sliced == ("unetrecurrent.pred.conv2d.weight", "unetrecurrent.pred.conv2d.bias")
    assert len(report.renamed) == len(state)
    assert "(in the file unetflow.head.conv2d.weight)" in str(report)
    assert "channel 0 only" in str(report)


def test_firenet_plus_names(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = FireNet()
    names = {
        "net.head.conv.conv2d": "head.conv2d",
        "net.head.recurrent_block.": "G1.",
        "net.resblocks.0.conv.": "R1.",
        "net.resblocks.0.recurrent_block.": "G2.",
        "net.resblocks.1.": "R2.",
        "net.pred.conv2d": "pred.conv2d",
    }
    state = {}
    for name, tensor in model.state_dict().items():
        (long,) = [long for long in names if name.startswith(long)]
        state[name.replace(long, names[long])] = tensor
    torch.save(state, tmp_path / "plus.pth")
    other = FireNet()
    load_into(other, tmp_path / "plus.pth")
    assert same(other.state_dict(), model.state_dict())


def test_a_misfit_is_reported_and_leaves_the_network_unchanged(tmp_path: Path) -> None:
    model = small()
    state = dict(model.state_dict())
    del state["unetrecurrent.head.conv2d.bias"]
    state["unetrecurrent.extra"] = torch.zeros(1)
    state["unetrecurrent.pred.conv2d.bias"] = torch.zeros(2)
    torch.save(state, tmp_path / "misfit.pth")
    other = small(seed=1)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(UsageError) as caught:
        load_into(other, tmp_path / "misfit.pth")
    assert same(other.state_dict(), before)
    for line in (
        "missing   unetrecurrent.head.conv2d.bias",
        "unused    unetrecurrent.extra",
        "misshaped unetrecurrent.pred.conv2d.bias",
    ):
        assert line in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"bins": 3, "base_channels": 4, "encoders": 1, "residual_blocks": 1},
        {"norm": "batch", "upsampling": "transposed", "final_activation": "sigmoid", "normalize_voxels": True},
    ],
)
def test_the_variant_of_e2vid_is_read_from_its_file(tmp_path: Path, options: dict[str, Any]) -> None:
    options = {"base_channels": 2, "encoders": 2, **options}
    model = E2VID(**options)
    content: dict[str, Any] = {"arch": "E2VIDRecurrent", "state_dict": model.state_dict()}
    if "final_activation" in options:
        content["model"] = {"num_bins": 5, "skip_type": "sum", "recurrent_block_type": "convlstm", "norm": "BN"}
    torch.save(content, tmp_path / "e2vid.pth.tar")
    name, found = read_weights(tmp_path / "e2vid.pth.tar").recognise()
    assert name == "e2vid"
    assert found == {
        "bins": 5,
        "residual_blocks": 2,
        "norm": "none",
        "upsampling": "bilinear",
        "final_activation": "none",
        "normalize_voxels": False,
        "padding": "centred" if "model" in content else "bottom-right",
        **options,
    }
    load_into(E2VID(**found), tmp_path / "e2vid.pth.tar")


def test_variants_that_are_not_built_are_refused(tmp_path: Path) -> None:
    content = {"state_dict": small().state_dict(), "config": ConfigParser({"num_bins": 5, "skip_type": "concat"})}
    torch.save(content, tmp_path / "concat.pth")
    with pytest.raises(UsageError, match="skip_type = 'concat'"):
        load_network(tmp_path / "concat.pth")


def test_published_files_say_how_their_network_was_trained(published: Path) -> None:
    file = read_weights(published / "firenet_evreal.pth")
    assert file.named_for(FireNet) == {name: name for name in file.state}
    assert (file.settings["num_bins"], file.settings["recurrent_block_type"]) == (5, "convgru")
    first, name = load_network(published / "firenet_evreal.pth")
    assert (name, first.normalizes, first.padding) == ("firenet", True, "centred")
    plus, name = load_network(published / "firenet_plus_state_dict.pth")
    assert (name, plus.normalizes, plus.padding) == ("firenet", False, "bottom-right")
