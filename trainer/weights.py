"""Load published weights: find a file's tensors, map their names, and recognise the network they belong to.

Files differ in container (a bare state dict; ``state_dict`` or ``model`` in a dict; with pickled objects beside it) and
in names (``module.`` and ``_orig_mod.`` of wrapped networks; each network class maps other differences). The
:class:`KeyReport` lists every rename and every tensor that does not fit. Loading is always strict.
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
"""FireNet trained on the stream alone. docs/model-card.md has its training data
and scores."""

Plain = str | int | float | bool | None


@dataclass(frozen=True)
class WeightFile:
    """Hold the content of a weight file.

    Attributes:
        path: the file.
        state: its tensors by their names in the file, on the CPU.
        settings: plain settings stored with them: the network's (``num_bins``, ``norm`` ...), ``normalize`` if its
            training normalised voxel grids, and ``padding`` if its code padded differently from V2V.
        trained_as: section ``network`` of the configuration, in this project's checkpoints; otherwise empty.
    """

    path: str
    state: Mapping[str, Tensor]
    settings: Mapping[str, Plain] = field(default_factory=dict)
    trained_as: Mapping[str, Any] = field(default_factory=dict)

    def named_for(self, kind: type[VoxelNetwork]) -> dict[str, str]:
        """Return the names in a network of this kind by their names in the file.

        Raises:
            UsageError: two keys get the same name although their tensors differ. (Tensors of modules that are
                registered twice are equal.)
        """
        names = {name: kind.own_name(name.replace("_orig_mod.", "").removeprefix("module.")) for name in self.state}
        first: dict[str, str] = {}
        for name, own in names.items():
            if not torch.equal(self.state[first.setdefault(own, name)], self.state[name]):
                raise UsageError(
                    f"{self.path}: two tensors have the same name without prefixes; give a file of one network"
                )
        return names

    def recognise(self, name: str | None = None) -> tuple[str, dict[str, Any]] | None:
        """Return name and arguments of the network that the weights belong to; None if it is not recognised.

        Args:
            name: key of NETWORKS that the user gave; None uses the name in this project's checkpoints, or else
                recognises the tensors.

        Raises:
            UsageError: the network, or the variant, is not implemented.
        """
        trained = self.trained_as.get("name")
        name = name or trained or next((known for known, kind in NETWORKS.items() if self._of(kind)), None)
        if name is None:
            return None
        if name not in NETWORKS:
            raise UsageError(f"model {name!r}: give one of {', '.join(NETWORKS)}")
        kind, arguments = NETWORKS[name], {}
        if self._of(kind):
            state = {new: self.state[old] for old, new in self.named_for(kind).items()}
            try:
                arguments = kind.from_state(state, self.settings)
            except KeyError as error:
                raise UsageError(f"{self.path}: weights of {name} with {error} missing") from error
        return name, arguments | (dict(self.trained_as.get("options", {})) if name == trained else {})

    def _of(self, kind: type[VoxelNetwork]) -> bool:
        return kind.recognises(self.named_for(kind).values())


@dataclass(frozen=True)
class KeyReport:
    """Report what was done with every tensor of a file. Names are those in the network.

    Attributes:
        path: the file.
        used: tensors that fit.
        renamed: name in the network by name in the file, where they differ.
        sliced: tensors of which only a part is used (E2VID+ also predicts flow; the image is channel 0).
        unused: tensors of the file that the network does not have.
        missing: tensors of the network that the file does not have.
        misshaped: tensors of both, with different shapes.
    """

    path: str
    used: tuple[str, ...]
    renamed: Mapping[str, str]
    sliced: tuple[str, ...]
    unused: tuple[str, ...]
    missing: tuple[str, ...]
    misshaped: tuple[str, ...]

    def __str__(self) -> str:
        """Return a summary, and one line per tensor."""
        original = {new: old for old, new in self.renamed.items()}
        lines = [
            f"{self.path}: {len(self.used)} tensors used, {len(self.unused)} unused, {len(self.missing)} missing, "
            f"{len(self.misshaped)} of another shape; {len(self.renamed)} renamed"
        ]
        for word in ("used", "unused", "missing", "misshaped"):
            for name in getattr(self, word):
                was = f"  (in the file {original[name]})" if name in original else ""
                lines.append(f"  {word:9} {name}{was}{', channel 0 only' if name in self.sliced else ''}")
        return "\n".join(lines)


def read_weights(path: str | Path, *, ema: bool = False) -> WeightFile:
    """Read a file of published weights or one of this project's checkpoints, without executing code from it.

    Args:
        path: a file of ``torch.save``, or ``shipped``: the network that comes with this package (:data:`SHIPPED`).
        ema: whether to take the averaged weights of one of this project's checkpoints.

    Raises:
        UsageError: there is no such file, it is not a PyTorch file, or it has no state dict.
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
    """Return the state dict of a file under its own names. Raises the errors of :func:`read_weights`."""
    return _state_dict(read_torch_file(path), path, ema=False)


def load_into(model: nn.Module, path: str | Path, *, ema: bool = False) -> KeyReport:
    """Load the weights of a file into a network. If one tensor does not fit, the network is unchanged.

    Raises:
        UsageError: as :func:`read_weights`, or a tensor is unused, missing or has another shape. The message contains
            the report.
    """
    file = read_weights(path, ema=ema)
    kind = type(model) if isinstance(model, VoxelNetwork) else VoxelNetwork
    names = file.named_for(kind)
    state = {new: kind.own_tensor(new, file.state[old]) for old, new in names.items()}
    wanted = model.state_dict()
    # Tables that a network computes itself; files of some releases do not contain them.
    state |= {name: wanted[name] for name in kind.computed if name in wanted and name not in state}
    report = KeyReport(
        path=str(path),
        used=tuple(name for name in state if name in wanted and state[name].shape == wanted[name].shape),
        renamed={old: new for old, new in names.items() if old != new},
        sliced=tuple(new for old, new in names.items() if state[new].shape != file.state[old].shape),
        unused=tuple(name for name in state if name not in wanted),
        missing=tuple(name for name in wanted if name not in state),
        misshaped=tuple(name for name in state if name in wanted and state[name].shape != wanted[name].shape),
    )
    if report.unused or report.missing or report.misshaped:
        raise UsageError(f"the weights do not fit {type(model).__name__}, so no tensor was loaded.\n{report}")
    model.load_state_dict(state)
    return report


def load_network(
    weights: str | Path, *, name: str | None = None, options: Mapping[str, Any] | None = None, ema: bool = False
) -> tuple[VoxelNetwork, str]:
    """Build the network that a weight file belongs to, with its weights.

    Args:
        weights: see :func:`read_weights`.
        name: key of NETWORKS; None: see :meth:`WeightFile.recognise`.
        options: arguments of the network; they override those found in the file.
        ema: whether to take the averaged weights of one of this project's checkpoints.

    Returns:
        The network in evaluation mode, on the CPU, and its name.

    Raises:
        UsageError: the file does not fit this network, or an option is unknown.
    """
    found = read_weights(weights, ema=ema).recognise(name)
    if found is None:
        raise UsageError(f"{weights}: the network is none of {', '.join(NETWORKS)}; a CONFIG can name it")
    name, arguments = found
    try:
        network = NETWORKS[name](**(arguments | dict(options or {})))
    except TypeError as error:
        raise UsageError(f"options of {name}: {error}") from error
    load_into(network, weights, ema=ema)
    return network.eval(), name


def _tensors(value: Any) -> dict[str, Tensor] | None:
    """Return ``value`` if it is a state dict, else None."""
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
        raise UsageError(f"{path} does not hold {where}; it holds {held[:200]}")
    return found


def _mappings(value: Any) -> Iterator[Mapping[Any, Any]]:
    """Yield every dict in nested plain containers and states of placeholders, outer ones first."""
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
    """Return the settings of :class:`WeightFile`. The network's are the first dict with the key ``num_bins``."""
    mappings = list(_mappings(content))
    network: Mapping[Any, Any] = next((mapping for mapping in mappings if "num_bins" in mapping), {})
    found = {str(name): value for name, value in network.items() if value is None or isinstance(value, Plain)}
    loader = next((item for mapping in mappings if isinstance(item := mapping.get("data_loader"), Mapping)), {})
    if isinstance(loader.get("normalize"), bool):
        found["normalize"] = loader["normalize"]
    if network and isinstance(content, Mapping):
        # Code of E2VID's family pads on all sides. V2V's does not, but its files hold no settings.
        found["padding"] = "centred"
        if network is content.get("model"):
            # E2VID's first release keeps its settings here; its sigmoid is in the code that reads them.
            found.setdefault("final_activation", "sigmoid")
    return found
