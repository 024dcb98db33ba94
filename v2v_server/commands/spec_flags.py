"""The flags for what a stream is made of: the same for a server's defaults and for remaking one of its samples."""

from __future__ import annotations

import argparse
from typing import Any

from v2v_protocol.command import Parser
from v2v_protocol.recipe import PRESETS
from v2v_protocol.settings import settings_of
from v2v_protocol.spec import SPEED_PRESETS, StreamSpec


def add_spec(parser: Parser) -> None:
    """``--preset``, ``--recipe``, ``--set``, and a flag for each field of a StreamSpec."""
    stream = parser.group("Stream")
    stream.add_argument("--preset", choices=tuple(SPEED_PRESETS), help="speed against accuracy (default exact)")
    stream.add_argument(
        "--recipe", metavar="NAME", help=f"virtual cameras: a preset ({', '.join(PRESETS)}) or a YAML file of fields"
    )
    stream.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change one recipe field, may be repeated"
    )
    parser.add_settings(StreamSpec)


def spec_fields(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the flags say, without ``--recipe`` and ``--set``; None where nothing was given."""
    return {name: getattr(arguments, name) for name in ("preset", *settings_of(StreamSpec))}
