"""Flags of a stream's spec, used for a server's defaults and for remaking one of its samples."""

from __future__ import annotations

import argparse
from typing import Any

from v2v_protocol.command import Parser
from v2v_protocol.recipe import PRESETS
from v2v_protocol.settings import settings_of
from v2v_protocol.spec import SPEED_PRESETS, StreamSpec


def add_spec(parser: Parser) -> None:
    """Add ``--preset``, ``--recipe``, ``--set``, and a flag for each field of a StreamSpec."""
    stream = parser.group("Stream")
    stream.add_argument(
        "--preset",
        choices=tuple(SPEED_PRESETS),
        help="trade accuracy for speed (default exact), or natural: clean videos as they are",
    )
    stream.add_argument(
        "--recipe", metavar="NAME", help=f"virtual cameras: a preset ({', '.join(PRESETS)}) or a YAML file of fields"
    )
    stream.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change one recipe field, may be repeated"
    )
    parser.add_settings(StreamSpec)


def spec_fields(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of these flags, without ``--recipe`` and ``--set``; None for a flag that was not given."""
    return {name: getattr(arguments, name) for name in ("preset", *settings_of(StreamSpec))}
