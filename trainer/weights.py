"""Published weights: which tensors a file has, under which names a network wants them, and what network they are of.

Files differ in container (a bare state dict; ``state_dict`` or ``model`` in a dict; with pickled objects beside it) and
in names (``module.`` and ``_orig_mod.`` of wrapped networks; what else differs, each network knows by itself). Every
rename, and every tensor that does not find its place, is in the :class:`KeyReport`; loading is always strict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from trainer.models import NETWORKS, VoxelNetwork
from trainer.unpickle import Placeholder, read_torch_file
from v2v_protocol.errors import UsageError

SHIPPED = Path(__file__).parent / "shipped" / "firenet.pt"
"""FireNet as ``firenet-cpu`` trained it, on the stream alone; docs/model-card.md says on what, and what it is worth."""

Plain = str | int | float | bool | None


@dataclass(frozen=True)
class WeightFile:
    """What a file of weights holds.

    Attributes:
        path: the file.
        state: its tensors by their names in the file, on the CPU.
        settings: plain settings beside them: those of the network (``num_bins``, ``norm`` ...), ``normalize`` where its
            training normalised voxel grids, ``padding`` where its code did not pad as V2V does.
        trained_as: section ``network`` of the configuration, in checkpoints of our own.
    """

    path: str
    state: Mapping[str, Tensor]
    settings: Mapping[str, Plain] = field(default_factory=dict)
    trained_as: Mapping[str, Any] = field(default_factory=dict)

    def named_for(self, kind: type[VoxelNetwork]) -> dict[str, str]:
        """Names in a network of this kind by name in the file.

        Raises:
            UsageError: two keys become one, and their tensors differ (modules that are registered twice do not).
        """
        names = {name: kind.own_name(name.replace("_orig_mod.", "").removeprefix("module.")) for name in self.state}
        first: dict[str, str] = {}
        for name, own in names.items():
            if not torch.equal(self.state[first.setdefault(own, name)], self.state[name]):
                raise UsageError(f"{self.path}: two tensors have the same name without prefixes; is it two networks?")
        return names

    def recognised(self, name: str | None = None) -> tuple[str, dict[str, Any]] | None:
        """Name and arguments of the network that the weights are of; None where nothing tells.

        Args:
            name: what they are, as somebody said; None takes what an own checkpoint says, else looks at the tensors.

        Raises:
            UsageError: a network, or a variant, that is not built here.
        """
        trained = self.trained_as.get("name")
        name = name or trained or next((known for known, kind in NETWORKS.items() if self._of(kind)), None)
        if name is None:
            return None
        if name not in NETWORKS:
            raise UsageError(f"model {name!r}: give one of {', '.join(NETWORKS)}")
        kind, told = NETWORKS[name], {}
        if self._of(kind):
            state = {new: self.state[old] for old, new in self.named_for(kind).items()}
            try:
                told = kind.from_state(state, self.settings)
            except KeyError as error:
                raise UsageError(f"{self.path}: weights of {name} with {error} missing") from error
        return name, told | (dict(self.trained_as.get("options", {})) if name == trained else {})

    def _of(self, kind: type[VoxelNetwork]) -> bool:
        return kind.recognises(self.named_for(kind).values())


@dataclass(frozen=True)
class KeyReport:
    """What became of every tensor of a file.

    Attributes:
        path: the file.
        used: names in the network of the tensors that fit.
        renamed: name in the network by name in the file, where they differ.
        cut: tensors of which only a part was taken (E2VID+ also predicts flow; the image is channel 0).
        unused: tensors of the file that the network has no place for.
        missing: tensors of the network that the file does not give.
        misshaped: tensors of both, of different shapes.
    """

    path: str
    used: tuple[str, ...]
    renamed: Mapping[str, str]
    cut: tuple[str, ...]
    unused: tuple[str, ...]
    missing: tuple[str, ...]
    misshaped: tuple[str, ...]

    def __str__(self) -> str:
        """One line per key."""
        original = {new: old for old, new in self.renamed.items()}
        lines = [
            f"{self.path}: {len(self.used)} tensors used, {len(self.unused)} unused, {len(self.missing)} missing, "
            f"{len(self.misshaped)} of another shape; {len(self.renamed)} renamed"
        ]
        for word in ("used", "unused", "missing", "misshaped"):
            for name in getattr(self, word):
                was = f"  (in the file {original[name]})" if name in original else ""
                lines.append(f"  {word:9} {name}{was}{', channel 0 only' if name in self.cut else ''}")
        return "\n".join(lines)


def read_weights(path: str | Path, *, ema: bool = False) -> WeightFile:
    """Read a published or own file of weights; nothing of it is executed.

    Args:
        path: a file of ``torch.save``, or ``shipped``: the network that comes with this package (:data:`SHIPPED`).
        ema: take the averaged weights of one of our own checkpoints.

    Raises:
        UsageError: no such file, not one of PyTorch, or without a state dict.
    """
    path = SHIPPED if str(path) == "shipped" else path
    content = read_torch_file(path)
    trained = content.get("config") if isinstance(content, Mapping) else None
    network = trained.get("network") if isinstance(trained, Mapping) else None
    return WeightFile(
        str(path),
        _state_dict(content, path, ema=ema),
        _settings(content),
        network if isinstance(network, Mapping) else {},
    )


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The state dict in a file, under its own names, as :func:`read_weights`."""
    return _state_dict(read_torch_file(path), path, ema=False)


def load_into(model: nn.Module, path: str | Path, *, ema: bool = False) -> KeyReport:
    """Give a network the weights of a file; all of them, or none.

    Raises:
        UsageError: as :func:`read_weights`, or a tensor is unused, missing or of another shape; the report is in the
            message.
    """
    file = read_weights(path, ema=ema)
    kind = type(model) if isinstance(model, VoxelNetwork) else VoxelNetwork
    names = file.named_for(kind)
    state = {new: kind.own_tensor(new, file.state[old]) for old, new in names.items()}
    wanted = model.state_dict()
    # Tables that a network computes by itself, and that files of some releases leave out.
    state |= {name: wanted[name] for name in kind.computed if name in wanted and name not in state}
    report = KeyReport(
        path=str(path),
        used=tuple(name for name in state if name in wanted and state[name].shape == wanted[name].shape),
        renamed={old: new for old, new in names.items() if old != new},
        cut=tuple(new for old, new in names.items() if state[new].shape != file.state[old].shape),
        unused=tuple(name for name in state if name not in wanted),
        missing=tuple(name for name in wanted if name not in state),
        misshaped=tuple(name for name in state if name in wanted and state[name].shape != wanted[name].shape),
    )
    if report.unused or report.missing or report.misshaped:
        raise UsageError(f"the weights do not fit {type(model).__name__}; nothing was loaded.\n{report}")
    model.load_state_dict(state)
    return report


def load_network(
    weights: str | Path, *, name: str | None = None, options: Mapping[str, Any] | None = None, ema: bool = False
) -> tuple[VoxelNetwork, str]:
    """The network that a file of weights is of.

    Args:
        weights: see :func:`read_weights`.
        name: key of NETWORKS; None: see :meth:`WeightFile.recognised`.
        options: arguments of the network; they override what file and tensors tell.
        ema: take the averaged weights of an own checkpoint.

    Returns:
        The network in evaluation mode, on the CPU, and its name.

    Raises:
        UsageError: the file is not of this network, or an option is unknown.
    """
    found = read_weights(weights, ema=ema).recognised(name)
    if found is None:
        raise UsageError(f"{weights}: of none of {', '.join(NETWORKS)}; --model says what it is")
    name, told = found
    try:
        network = NETWORKS[name](**(told | dict(options or {})))
    except TypeError as error:
        raise UsageError(f"options of {name}: {error}") from error
    load_into(network, weights, ema=ema)
    return network.eval(), name


def _tensors(value: Any) -> dict[str, Tensor] | None:
    """``value`` where it is a state dict."""
    if isinstance(value, Mapping) and value and all(isinstance(tensor, Tensor) for tensor in value.values()):
        return {str(name): tensor.detach() for name, tensor in value.items()}
    return None


def _state_dict(content: Any, path: str | Path, *, ema: bool) -> dict[str, Tensor]:
    if isinstance(content, Mapping):
        for place in ("ema",) if ema else ("state_dict", "model"):
            found = _tensors(content.get(place))
            if found is not None:
                return found
    found = None if ema else _tensors(content)
    if found is None:
        where = "averaged weights under 'ema'" if ema else "a state dict, alone or under 'state_dict' or 'model'"
        held = ", ".join(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
        raise UsageError(f"{path}: looked for {where}; it holds {held[:200]}")
    return found


def _mappings(value: Any) -> Iterator[Mapping[Any, Any]]:
    """Every dict within plain containers and the states of placeholders, outer ones first."""
    pending, seen = [value], set()
    while pending:
        item = pending.pop(0)
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, Mapping):
            yield item
            pending.extend(item.values())
        elif isinstance(item, (list, tuple)):
            pending.extend(item)
        elif isinstance(item, Placeholder):
            pending.extend(item.content)


def _settings(content: Any) -> dict[str, Plain]:
    """See :class:`WeightFile`; the network's are the first dict that speaks of ``num_bins``."""
    mappings = list(_mappings(content))
    network: Mapping[Any, Any] = next((mapping for mapping in mappings if "num_bins" in mapping), {})
    found = {str(name): value for name, value in network.items() if value is None or isinstance(value, Plain)}
    loader = next((item for mapping in mappings if isinstance(item := mapping.get("data_loader"), Mapping)), {})
    if isinstance(loader.get("normalize"), bool):
        found["normalize"] = loader["normalize"]
    if network and isinstance(content, Mapping):
        # Code of E2VID's family (but not V2V's, which keeps none of its settings) pads on all sides.
        found["padding"] = "centred"
        if network is content.get("model"):
            # E2VID's first release keeps its settings here, and its sigmoid is in the code that reads them.
            found.setdefault("final_activation", "sigmoid")
    return found
