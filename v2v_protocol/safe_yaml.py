"""Read YAML: values of plain types, of bounded size. Every configuration and recipe is read here.

An alias (``*name``) repeats the node that it names, so nine lines of nine aliases each stand for 10**9 values. Aliases
are refused: the size of a file then bounds its values.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

LARGEST_BYTES = 1 << 20
MOST_LEVELS = 32


class YamlError(ValueError):
    """A text that is not YAML, or exceeds a limit of this module. The message is one line."""


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text; None for an empty one.

    Raises:
        YamlError: it is not YAML, has a key twice or an alias, or exceeds :data:`MOST_LEVELS`.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise YamlError(" ".join(str(error).split())[:200]) from error
    # Raised for values that do not fit their tag: an invalid date, `!!int ""`, `!!bool 3`, `!!timestamp x`.
    except (ValueError, LookupError, AttributeError, TypeError, OverflowError) as error:
        raise YamlError(f"a value does not fit its type: {' '.join(str(error).split())[:160]}") from error


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Return the value of a YAML file.

    Raises:
        YamlError: it is not UTF-8, is larger than :data:`LARGEST_BYTES`, or see :func:`parse_yaml`.
        OSError: it cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
    except ValueError as error:  # a NUL in the name
        raise YamlError(f"the file's name: {error}") from error
    if len(data) > LARGEST_BYTES:
        raise YamlError(f"the file has more than {LARGEST_BYTES} bytes, the limit; is it the right file?")
    try:
        return parse_yaml(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise YamlError(f"not UTF-8 text: {error.reason} at byte {error.start}") from error


def format_yaml(value: Any) -> str:
    """Return plain values as YAML that :func:`parse_yaml` reads back, keys in their order."""
    formatted: str = yaml.safe_dump(value, sort_keys=False)
    return formatted


class _Loader(yaml.SafeLoader):
    """Loader that refuses aliases, deep texts, and duplicate keys (SafeLoader silently takes the last)."""

    _level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        is_alias, self._level = self.check_event(yaml.AliasEvent), self._level + 1
        if is_alias or self._level > MOST_LEVELS:  # before a deep text is descended into
            why = "an alias (*name): write its value again" if is_alias else f"more than {MOST_LEVELS} levels"
            raise yaml.composer.ComposerError(None, None, why, self.peek_event().start_mark)  # type: ignore[no-untyped-call]
        node = super().compose_node(parent, index)
        self._level -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # no key of ours
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} appears twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _whole_or_text(loader: _Loader, node: yaml.ScalarNode) -> Any:
    """Construct an integer, or text. 8:32 stays text; YAML 1.1 would read the base-60 number 512."""
    return loader.construct_scalar(node) if ":" in node.value else loader.construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _whole_or_text)
