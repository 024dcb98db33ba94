"""Configuration files: YAML in which ``extends`` names another file to start from, changed by ``--set KEY=VALUE``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from trainer.config import TrainConfig
from v2v_protocol.errors import UsageError
from v2v_protocol.safe_yaml import YamlError, format_yaml, parse_yaml, read_yaml
from v2v_protocol.settings import nearest

EXTENDS = "extends"


def shipped() -> list[str]:
    """Return the names of the configurations that come with the package."""
    folder = resources.files("trainer") / "configs"
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def load_config(file: str, settings: Sequence[str] = (), base: Mapping[str, Any] | None = None) -> TrainConfig:
    """Read a configuration.

    Args:
        file: YAML, or the name of a shipped configuration. ``extends: other.yaml`` (beside the file, or the name of a
            shipped one) starts from that one, so that the file holds only what differs.
        settings: "key=value" texts, keys with their section, values in YAML; they override the file.
        base: nested values to take where neither says anything, instead of the defaults.

    Raises:
        UsageError: a file cannot be read, a setting is malformed, or see :class:`trainer.config.TrainConfig`.
    """
    values = _merged(base or {}, _read(file))
    for setting in settings:
        _set(values, setting)
    return TrainConfig.from_dict(values)


def show_config(config: TrainConfig) -> str:
    """Format all keys of a configuration as YAML, which ``v2v-train`` reads."""
    return format_yaml(config.to_dict())


def _read(file: str, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    path = Path(file)
    if not path.is_file() and file in shipped():
        path = Path(str(resources.files("trainer") / "configs" / f"{file}.yaml"))
    if str(path.resolve()) in seen:
        raise UsageError(f"{file}: extends itself")
    try:
        values = read_yaml(path)
    except OSError as error:
        videos = f"; give the videos after a configuration: v2v-train NAME --videos {file}" if path.is_dir() else ""
        hint = videos or nearest(file, shipped())
        raise UsageError(f"{file}: {error.strerror}{hint}; shipped configurations: {', '.join(shipped())}") from error
    except YamlError as error:
        raise UsageError(f"{file}: not YAML: {error}") from error
    values = {} if values is None else values
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise UsageError(f"{file}: expected sections of keys and values, found {type(values).__name__}")
    base = values.pop(EXTENDS, None)
    if base is None:
        return values
    beside = path.parent / str(base)
    return _merged(_read(str(beside) if beside.is_file() else str(base), (*seen, str(path.resolve()))), values)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return merged


def _set(values: dict[str, Any], setting: str) -> None:
    name, equals, text = setting.partition("=")
    *groups, key = name.strip().split(".")
    if not equals or not groups or not all((*groups, key)):
        raise UsageError(f"--set {setting}: write SECTION.KEY=VALUE, for instance --set optimizer.learning_rate=1e-4")
    try:
        value = parse_yaml(text)
    except YamlError as error:
        raise UsageError(f"--set {setting}: {text!r} is not a value in YAML") from error
    place = values
    for group in groups:
        place = place.setdefault(group, {})
        if not isinstance(place, dict):
            raise UsageError(f"--set {setting}: {group} is {place!r} in the file, not a group of keys")
    place[key] = "" if value is None else value
