"""A network from a file of weights: which one it is, and with which settings it was built."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from trainer.models import NETWORKS, ReconstructionNetwork
from trainer.unpickle import read_torch_file
from trainer.weights import KeyReport, e2vid_options, load_into, load_weights
from v2v_protocol.errors import UsageError

HEADS = {"e2vid": "unetrecurrent.head.conv2d.weight", "firenet": "net.head.conv.conv2d.weight"}
"""The tensor by which a network is recognised."""


def load_network(
    weights: str | Path, *, name: str | None = None, options: Mapping[str, Any] | None = None, ema: bool = False
) -> tuple[ReconstructionNetwork, str]:
    """
    Args:
        weights: see :func:`trainer.weights.load_weights`.
        name: key of NETWORKS; None takes what an own checkpoint says, else recognises E2VID and FireNet by their
            tensors.
        options: arguments of the network; they override what file and tensors tell. Whether FireNet normalises its
            input is nothing that tensors tell: published FireNet does, FireNet+ does not (the default).
        ema: take the averaged weights of an own checkpoint.

    Returns:
        The network in evaluation mode, on the CPU, and its name.

    Raises:
        UsageError: the file is not of this network, or an option is unknown.
    """
    name, told = _recognised(weights, name, ema=ema)
    arguments = {**told, **(options or {})}
    try:
        network = NETWORKS[name](**arguments)
    except TypeError as error:
        raise UsageError(f"options of {name}: {error}") from error
    load_into(network, weights, ema=ema)
    return network.eval(), name


def fitting(weights: str | Path) -> tuple[str, dict[str, Any]] | None:
    """Name and arguments of the network that a file of weights is of; None where nothing tells.

    Raises:
        UsageError: the file cannot be read.
    """
    state, _ = load_weights(weights)
    if not any(head in state for head in HEADS.values()):
        return None
    return _recognised(weights, None, ema=False)


def _recognised(weights: str | Path, name: str | None, *, ema: bool) -> tuple[str, dict[str, Any]]:
    state, report = load_weights(weights, ema=ema)
    trained = _trained_as(weights)
    if name is None:
        name = trained.get("name") or next((known for known, head in HEADS.items() if head in state), None)
        if name is None:
            raise UsageError(f"{weights}: neither an E2VID nor a FireNet; --model says what it is")
    if name not in NETWORKS:
        raise UsageError(f"model {name!r}: give one of {', '.join(NETWORKS)}")
    stated = trained.get("options", {}) if name == trained.get("name") else {}
    return name, {**_told_by_tensors(name, state, report), **stated}


def _trained_as(weights: str | Path) -> Mapping[str, Any]:
    """``network`` of the configuration in an own checkpoint; nothing for other files."""
    content: Any = read_torch_file(weights)
    for key in ("config", "network"):
        content = content.get(key) if isinstance(content, Mapping) else None
    return content if isinstance(content, Mapping) else {}


def _told_by_tensors(name: str, state: Mapping[str, Tensor], report: KeyReport) -> dict[str, Any]:
    if name == "e2vid" and HEADS[name] in state:
        return e2vid_options(state, report.settings)
    if name == "firenet" and HEADS[name] in state:
        base_channels, bins = state[HEADS[name]].shape[:2]
        return {"bins": bins, "base_channels": base_channels}
    return {}
