"""Flags that name samples of a stream, and what makes those samples."""

from __future__ import annotations

import argparse

from v2v_protocol.command import Parser
from v2v_protocol.programs import show
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import asked_recipe, recipe_setting, spec_fields
from v2v_server.config import ServeConfig
from v2v_server.kinds.registry import KindFlags, kind_from
from v2v_server.quarantine import Quarantine, quarantine_path, read_quarantine
from v2v_tools.remake import Remaker, open_shown


def add_samples(parser: Parser) -> argparse._ArgumentGroup:
    """Add the flags of a corpus, and of a sample's name in it; return their group."""
    which = parser.group("Which sample")
    which.add_argument("video", metavar="VIDEO", help="a video; or a folder or list file, to remake a streamed sample")
    which.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the stream (default 0)")
    which.add_argument("--epoch", type=int, default=0, metavar="N", help="default 0")
    which.add_argument("--index", type=int, default=0, metavar="N", help="global index in the epoch (default 0)")
    which.add_argument(
        "--quarantine",
        type=int,
        default=0,
        metavar="N",
        help="number of the quarantine snapshot in the sample's provenance",
    )
    parser.add_settings(ServeConfig, "list", "rows", "cache_dir")
    parser.add_settings(KindFlags)
    return which


def asked_spec(asked: argparse.Namespace) -> StreamSpec:
    """Return the spec that the flags state, with its warnings shown."""
    spec = StreamSpec.from_dict(spec_fields(asked) | {"recipe": recipe_setting(asked_recipe(asked), asked.set)})
    spec.recipe.warn()
    return spec


def asked_remaker(asked: argparse.Namespace, spec: StreamSpec, arrays: tuple[str, ...]) -> Remaker:
    """Open the corpus that the flags name. Errors: :func:`open_shown` and :class:`Remaker`."""
    catalogue = open_shown(
        asked.video, list_file=asked.list, rows=asked.rows or "full", scene=spec.scene != "off",
        cache_dir=asked.cache_dir, kind=kind_from(vars(asked)),
    )  # fmt: skip
    path = quarantine_path(catalogue.source.name, asked.cache_dir)
    quarantine = read_quarantine(path) if asked.quarantine else Quarantine()
    quarantine.entries(asked.quarantine)  # before any work: whether there is such a snapshot
    for refusal in catalogue.refusals:
        show(f"cannot be used: {refusal}")
    return Remaker(catalogue, spec, arrays, quarantine, asked.quarantine)
