"""Published weights of reconstruction networks: which tensors a file has, under which names a network wants them.

Files differ in container (a bare state dict; ``state_dict`` or ``model`` in a dict; with pickled objects beside it)
and in names (``module.`` and ``_orig_mod.`` of wrapped networks, ``unetflow.`` of E2VID+, the short names of FireNet+).
Every rename, and every tensor that does not find its place, is in the :class:`KeyReport`; loading is always strict.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from trainer.unpickle import Placeholder, read_torch_file
from v2v_protocol.errors import UsageError

Plain = str | int | float | bool | None

FIRENET_PLUS = {
    "head.conv2d": "net.head.conv.conv2d",
    "G1": "net.head.recurrent_block",
    "R1": "net.resblocks.0.conv",
    "G2": "net.resblocks.0.recurrent_block",
    "R2": "net.resblocks.1",
    "pred.conv2d": "net.pred.conv2d",
}
"""FireNet+ is FireNet with its layers under other names."""

PREDICTION = re.compile(r"unetrecurrent\.pred\.conv2d\.(weight|bias)")


@dataclass(frozen=True)
class KeyReport:
    """What became of every tensor of a file.

    Attributes:
        path: the file.
        used: names in the network of the tensors that fit.
        renamed: name in the network by name in the file, where they differ.
        cut: tensors of which only the part for the image was taken (E2VID+ also predicts flow; the image is channel 0).
        unused: tensors of the file that the network has no place for.
        missing: tensors of the network that the file does not give.
        misshaped: tensors of both, of different shapes.
        settings: plain settings of the network that the file holds beside the tensors (``num_bins``, ``norm`` ...).
    """

    path: str
    used: tuple[str, ...]
    renamed: Mapping[str, str] = field(default_factory=dict)
    cut: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    misshaped: tuple[str, ...] = ()
    settings: Mapping[str, Plain] = field(default_factory=dict)

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
    """The settings of the network: the first dict that speaks of ``num_bins``."""
    found: dict[str, Plain] = {}
    for mapping in _mappings(content):
        if "num_bins" in mapping:
            for name, value in mapping.items():
                if value is None or isinstance(value, (str, int, float)):
                    found[str(name)] = value
            if isinstance(content, Mapping) and mapping is content.get("model"):
                # E2VID's first release keeps its settings here, and its sigmoid is in the code that reads them.
                found.setdefault("final_activation", "sigmoid")
            break
    return found


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The state dict in a file, under its own names, on the CPU; nothing of the file is executed.

    Raises:
        UsageError: no such file, not one of PyTorch, or without a state dict.
    """
    return _state_dict(read_torch_file(path), path, ema=False)


def _canonical(name: str, *, short: bool) -> str:
    """The name that our networks use."""
    name = name.replace("_orig_mod.", "").removeprefix("module.")
    name = re.sub(r"^unetflow\.", "unetrecurrent.", name)
    if short:
        for old, new in FIRENET_PLUS.items():
            if name.startswith(f"{old}."):
                return new + name.removeprefix(old)
    return name


def load_weights(path: str | Path, *, ema: bool = False) -> tuple[dict[str, Tensor], KeyReport]:
    """The tensors of a published or own checkpoint under the names of our networks, on the CPU.

    Args:
        path: a file of ``torch.save``: E2VID, E2VID+, FireNet, FireNet+, V2V's or our own.
        ema: take the averaged weights of one of our own checkpoints.

    Returns:
        The state dict, and the report of its keys (without a network to compare with, all of them count as used).

    Raises:
        UsageError: no such file, not one of PyTorch, without a state dict, or two keys become one.
    """
    content = read_torch_file(path)
    found = _state_dict(content, path, ema=ema)
    short = any("G1.reset_gate" in name for name in found)
    names = {name: _canonical(name, short=short) for name in found}
    if len(set(names.values())) < len(names):
        raise UsageError(f"{path}: two tensors have the same name once prefixes are removed; is it two networks?")
    state, cut = {}, []
    for old, new in names.items():
        state[new] = found[old]
        if PREDICTION.fullmatch(new) and found[old].shape[0] == 3:
            state[new] = found[old][:1].clone()
            cut.append(new)
    report = KeyReport(
        path=str(path),
        used=tuple(state),
        renamed={old: new for old, new in names.items() if old != new},
        cut=tuple(cut),
        settings=_settings(content),
    )
    return state, report


def load_into(model: nn.Module, path: str | Path, *, ema: bool = False) -> KeyReport:
    """Give a network the weights of a file; all of them, or none.

    Raises:
        UsageError: as :func:`load_weights`, or a tensor is unused, missing or of another shape; the report is in
            the message.
    """
    state, report = load_weights(path, ema=ema)
    wanted = model.state_dict()
    report = dataclasses.replace(
        report,
        used=tuple(name for name in state if name in wanted and state[name].shape == wanted[name].shape),
        unused=tuple(name for name in state if name not in wanted),
        missing=tuple(name for name in wanted if name not in state),
        misshaped=tuple(name for name in state if name in wanted and state[name].shape != wanted[name].shape),
    )
    if report.unused or report.missing or report.misshaped:
        raise UsageError(f"the weights do not fit {type(model).__name__}; nothing was loaded.\n{report}")
    model.load_state_dict(state)
    return report


def e2vid_options(state: Mapping[str, Tensor], settings: Mapping[str, Plain]) -> dict[str, Any]:
    """The arguments of :class:`trainer.models.E2VID` under which a file's weights fit.

    Sizes, norm and upsampling are read from the tensors; the first release's sigmoid, and with it the normalisation of
    its input, from the settings.

    Args:
        state, settings: of :func:`load_weights`.

    Raises:
        UsageError: not an E2VID, or a variant that is not built here.
    """
    head = state.get("unetrecurrent.head.conv2d.weight")
    if head is None:
        raise UsageError("these are not weights of an E2VID: there is no unetrecurrent.head.conv2d.weight")
    for name, built in (("skip_type", "sum"), ("recurrent_block_type", "convlstm")):
        if settings.get(name, built) != built:
            raise UsageError(f"E2VID with {name} = {settings[name]!r} is not built here, only {built!r}")
    sigmoid = settings.get("final_activation") == "sigmoid"
    return {
        "bins": head.shape[1],
        "base_channels": head.shape[0],
        "encoders": sum(name.endswith("recurrent_block.Gates.weight") for name in state),
        "residual_blocks": sum(bool(re.fullmatch(r".*resblocks\.\d+\.conv1\.weight", name)) for name in state),
        "norm": "batch" if any(name.endswith("norm_layer.running_mean") for name in state) else "none",
        "upsampling": "transposed" if any("transposed_conv2d" in name for name in state) else "bilinear",
        "final_activation": "sigmoid" if sigmoid else "none",
        "normalize_voxels": sigmoid,
    }
