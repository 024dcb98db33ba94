"""Flags of a stream's spec, and recipes by name, from files and from `--set KEY=VALUE`.

Every command that makes samples takes the same flags: a server's defaults, a consumer's requests, a preview.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LISTED, PRESETS, STREAM_PRESETS
from v2v_protocol.safe_yaml import YamlError, parse_yaml, read_yaml
from v2v_protocol.settings import nearest, settings_of
from v2v_protocol.spec import StreamSpec

_RECIPE_FILES = (".yaml", ".yml")


def add_recipe(parser: Parser, group: str = "Stream") -> None:
    """Add ``--recipe`` and ``--set``."""
    named = ", ".join(LISTED)
    recipe = parser.group(group)
    recipe.add_argument(
        "--recipe", metavar="NAME", help=f"virtual cameras: {named}, or a YAML file of fields (default paper)"
    )
    recipe.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change one recipe field, may be repeated"
    )


def add_spec(parser: Parser) -> None:
    """Add ``--preset``, ``--recipe``, ``--set``, and a flag for each field of a StreamSpec."""
    parser.group("Stream").add_argument(
        "--preset",
        type=_stream_preset,
        metavar="NAME",
        help=f"a choice of stream settings: {', '.join(STREAM_PRESETS)} (default exact). The first three trade "
        "accuracy for speed; natural cleans videos as they are; natural-davis346 also shows them to a camera that has "
        "run for a while",
    )
    add_recipe(parser)
    parser.add_settings(StreamSpec)


def _stream_preset(name: str) -> str:
    if name not in STREAM_PRESETS:
        is_recipe = name in PRESETS or name.endswith(_RECIPE_FILES)
        hint = f", or give --recipe {name}" if is_recipe else nearest(name, STREAM_PRESETS)
        raise argparse.ArgumentTypeError(f"{name!r}: choose one of {', '.join(STREAM_PRESETS)}{hint}")
    return name


def asked_recipe(arguments: argparse.Namespace) -> str | None:
    """Return the value of ``--recipe``, else the recipe of ``--preset``; None if neither names one."""
    recipe: str | None = arguments.recipe or STREAM_PRESETS.get(arguments.preset or "", {}).get("recipe")
    return recipe


def spec_fields(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of these flags, without ``--recipe`` and ``--set``; None for a flag that was not given.

    Raises:
        UsageError: a flag has no effect.
    """
    scene = StreamSpec.from_dict({"preset": arguments.preset, "scene": arguments.scene}).scene
    if arguments.keep_defects and scene == "off" and not getattr(arguments, "connect", None):
        raise UsageError("--keep-defects has no effect without --scene auto; give both, or neither")
    return {name: getattr(arguments, name) for name in ("preset", *settings_of(StreamSpec))}


def recipe_setting(recipe: str | None, settings: Sequence[str], configured: Any = None) -> Any:
    """Return the recipe of :func:`recipe_changes`, with all its fields; None if nothing was given.

    Raises:
        UsageError: see :func:`recipe_changes`; or a field is unknown or outside its limits.
    """
    fields = recipe_changes(recipe, settings, configured)
    return None if fields is None else StreamSpec.from_dict({"recipe": fields}).recipe


def recipe_changes(recipe: str | None, settings: Sequence[str], configured: Any = None) -> dict[str, Any] | None:
    """Combine `--recipe` and any number of `--set KEY=VALUE`.

    Args:
        recipe: a recipe's name, a YAML file of recipe fields (it may name the recipe to start from, ``preset``), or
            None.
        settings: "key=value" texts, values in YAML ("[0.2, 0.5]", "true", "3").
        configured: recipe of a configuration file, used without ``recipe``: a name or a mapping of fields.

    Returns:
        the stated fields only; None if nothing was given.

    Raises:
        UsageError: the file cannot be read, or a setting is not "key=value".
    """
    if recipe is None and not settings:
        return None
    stated = read_recipe(configured if recipe is None else recipe)
    fields: dict[str, Any] = {}
    if stated is not None:
        fields = dict(stated) if isinstance(stated, Mapping) else {"preset": stated}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise UsageError(f"--set {setting}: write KEY=VALUE, for instance --set voxels_per_clip=5")
        try:
            fields[key.strip()] = parse_yaml(text)
        except YamlError as error:
            raise UsageError(f"--set {setting}: {text!r} is not a value") from error
    return fields


def read_recipe(recipe: Any) -> Any:
    """Return the fields of a recipe that is named by its YAML file; anything else as it is.

    Raises:
        UsageError: the file cannot be read.
    """
    is_file = isinstance(recipe, str) and recipe.endswith(_RECIPE_FILES)
    return read_yaml_mapping("recipe", recipe) if is_file else recipe


def read_yaml_mapping(flag: str, file: str) -> dict[str, Any]:
    """Read a YAML file that holds a mapping.

    Raises:
        UsageError: it cannot be read, has a key twice, or holds something else; the message names the flag.
    """
    try:
        values = read_yaml(file)
    except OSError as error:
        raise UsageError(f"{flag} {file}: {error.strerror}") from error
    except YamlError as error:
        raise UsageError(f"{flag} {file}: not YAML: {error}") from error
    if values is None:
        return {}
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise UsageError(f"{flag} {file}: expected keys and values, found {type(values).__name__}")
    return values
