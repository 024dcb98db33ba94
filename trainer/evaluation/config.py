"""Read the configuration of an evaluation: a YAML file, or a shipped one by its name.

Its keys:

    model: {name: e2vid, options: {final_activation: none}}    # both optional, derived from the weights by default
    voxels: {kind: discrete, bins: 5, span: events}
    metrics: [mse, ssim_range2, ssim, correlation, lpips_alex]
    data:
      - HQF                                                    # of the paper, with its time ranges
      - {name: mine, folder: recordings, sequences: {corridor: [0, 10], desk: null}}
    paper: [E2VID WebVid10K]                                   # rows of the paper's tables to show as well
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from trainer.evaluation import paper
from trainer.evaluation.data_sets import DATA_SETS, DataSet, TimeRange
from trainer.evaluation.metrics import METRICS
from trainer.evaluation.voxelise import VoxelSettings
from v2v_protocol.errors import UsageError
from v2v_protocol.safe_yaml import YamlError, read_yaml
from v2v_recordings.layout import SUFFIXES

DEFAULT_METRICS = ("mse", "ssim_range2", "ssim", "correlation")
KEYS = ("model", "voxels", "metrics", "data", "paper")


@dataclass(frozen=True)
class EvaluationConfig:
    """Hold what to evaluate.

    Attributes:
        data_sets: in the order of evaluation.
        model: key of ``trainer.models.NETWORKS``; None recognises the weights.
        model_options: arguments of the network that override those derived from the weights.
        voxels: how windows become voxel grids; None means discrete with as many bins as the network takes.
        metrics: names in ``trainer.evaluation.metrics.METRICS``.
        paper: methods of ``trainer.evaluation.paper.RESULTS`` or ``FLOW`` to show as well.
    """

    data_sets: tuple[DataSet, ...]
    model: str | None = None
    model_options: Mapping[str, Any] = field(default_factory=dict)
    voxels: VoxelSettings | None = None
    metrics: tuple[str, ...] = DEFAULT_METRICS
    paper: tuple[str, ...] = ()


def shipped() -> dict[str, Path]:
    """Return the paths of the shipped configurations by name."""
    folder = resources.files("trainer.evaluation") / "configs"
    return {Path(file.name).stem: Path(str(file)) for file in folder.iterdir() if file.name.endswith(".yaml")}


def read_config(name: str) -> EvaluationConfig:
    """Read a configuration.

    Args:
        name: path of a YAML file, or name of a shipped configuration.

    Raises:
        UsageError: there is no such file, or a value in it is not valid; the message names the key.
    """
    path = Path(name)
    if not path.is_file():
        known = shipped()
        if name not in known:
            raise UsageError(f"no file {name}; shipped configurations: {', '.join(sorted(known))}")
        path = known[name]
    try:
        content = read_yaml(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    except YamlError as error:
        raise UsageError(f"{path} is not YAML: {error}") from error
    return parse_config(content, str(path))


def parse_config(content: Any, where: str) -> EvaluationConfig:
    """Check parsed YAML as :func:`read_config` does; ``where`` names it in messages.

    Raises:
        UsageError: see :func:`read_config`.
    """
    top = _mapping(content, where, KEYS)
    model = _mapping(top.get("model", {}), f"{where}: model", ("name", "options"))
    voxels = _mapping(top.get("voxels", {}), f"{where}: voxels", ("kind", "bins", "span"))
    data_sets = tuple(_data_set(entry, f"{where}: data") for entry in _list(top.get("data"), f"{where}: data"))
    names = [data_set.name for data_set in data_sets]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"{where}: data: two data sets are named {twice}: give each its own name")
    return EvaluationConfig(
        data_sets=data_sets,
        model=model.get("name"),
        model_options=_options(model.get("options"), f"{where}: model: options"),
        voxels=VoxelSettings(**voxels) if voxels else None,
        metrics=_known(top.get("metrics", list(DEFAULT_METRICS)), METRICS, f"{where}: metrics"),
        paper=_known(top.get("paper", []), (*paper.RESULTS, *paper.FLOW), f"{where}: paper"),
    )


def folder_config(path: Path) -> EvaluationConfig:
    """Return a configuration for all recordings of a folder, or a single file, as one data set without time ranges.

    Raises:
        UsageError: the folder has no recordings.
    """
    files = [path] if path.is_file() else sorted(file for file in path.glob("*") if file.suffix.lower() in SUFFIXES)
    if not files:
        raise UsageError(f"{path} has no recordings ({', '.join(SUFFIXES)}); convert raw ones with v2v-convert")
    return EvaluationConfig(
        (DataSet(Path(os.path.abspath(path)).stem, ".", dict.fromkeys(file.stem for file in files)),)
    )


def _data_set(entry: Any, where: str) -> DataSet:
    if isinstance(entry, str):
        if entry not in DATA_SETS:
            raise UsageError(f"{where}: {entry!r} is none of the paper's: {', '.join(DATA_SETS)}. Describe others by "
                             "{name, folder, sequences}")  # fmt: skip
        return DATA_SETS[entry]
    given = _mapping(entry, where, ("name", "folder", "sequences"))
    if "name" not in given or not given.get("sequences"):
        raise UsageError(f"{where}: a data set needs a name and sequences")
    sequences = given["sequences"]
    if isinstance(sequences, list):
        sequences = dict.fromkeys(map(str, sequences))
    if not isinstance(sequences, Mapping):
        raise UsageError(f"{where}: sequences {sequences!r}: give a list, or [first, last] second by name")
    time_ranges = {str(name): _time_range(span, f"{where}: {name}") for name, span in sequences.items()}
    return DataSet(str(given["name"]), str(given.get("folder", given["name"])), time_ranges)


def _time_range(value: Any, where: str) -> TimeRange | None:
    if value is None:
        return None
    if not (isinstance(value, list) and len(value) == 2 and all(isinstance(edge, (int, float)) for edge in value)):
        raise UsageError(f"{where}: {value!r} is not [first second, last second]")
    start, end = float(value[0]), float(value[1])
    if not 0 <= start < end:
        raise UsageError(f"{where}: [{start:g}, {end:g}] s is not a time range: give 0 <= first < last")
    return start, end


def _options(value: Any, where: str) -> dict[str, Any]:
    """Check that options are a mapping of names; the network checks which ones."""
    if value is not None and not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
        raise UsageError(f"{where}: {value!r} should be names and values")
    return dict(value or {})


def _mapping(value: Any, where: str, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise UsageError(f"{where}: {value!r} should have the keys {', '.join(keys)}")
    unknown = [str(key) for key in value if key not in keys]
    if unknown:
        raise UsageError(f"{where}: unknown key {unknown[0]!r}; there are {', '.join(keys)}")
    return dict(value)


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise UsageError(f"{where}: {value!r} should be a list")
    return value


def _known(value: Any, names: Collection[str], where: str) -> tuple[str, ...]:
    entries = value if isinstance(value, list) else [value]
    unknown = [entry for entry in entries if entry not in names]
    if unknown:
        raise UsageError(f"{where}: {unknown[0]!r} is none of {', '.join(names)}")
    return tuple(entries)
