"""Flags that name samples of a stream or whole videos, what makes them, and the folder for them."""

from __future__ import annotations

import argparse
from pathlib import Path

from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError, system_errors
from v2v_protocol.programs import show
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import asked_recipe, recipe_setting, spec_fields
from v2v_protocol.write_aside import make_output_folder
from v2v_recordings.writers import EVENT_FORMS
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.kinds.registry import KindFlags, kind_from
from v2v_server.quarantine import Quarantine, quarantine_path, read_quarantine
from v2v_tools.remake import Remaker, open_shown


def add_corpus(parser: Parser, title: str, video: str) -> argparse._ArgumentGroup:
    """Add the flags of a corpus, and of a camera's seed and epoch, under a title; return their group."""
    which = parser.group(title)
    which.add_argument("video", metavar="VIDEO", help=video)
    which.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the stream (default 0)")
    which.add_argument(
        "--epoch", type=int, default=0, metavar="N", help="epoch of the stream: other cameras (default 0)"
    )
    parser.add_settings(ServeConfig, "list", "rows", "cache_dir")
    parser.add_settings(KindFlags)
    return which


def add_samples(parser: Parser) -> argparse._ArgumentGroup:
    """Add the flags of a corpus, and of a sample's name in it; return their group."""
    which = add_corpus(parser, "Which sample", "a video; or a folder or list file, to remake a streamed sample")
    which.add_argument("--index", type=int, default=0, metavar="N", help="global index in the epoch (default 0)")
    which.add_argument(
        "--quarantine", type=int, default=0, metavar="N",
        help="number of the quarantine snapshot in the sample's provenance",
    )  # fmt: skip
    return which


def add_folder(parser: Parser, content: str, default: str | None = None) -> argparse._ArgumentGroup:
    """Add the flags of a folder of recordings and their form; return their group."""
    out = parser.group("Output")
    out.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {content}")
    out.add_argument(
        "--events", choices=tuple(EVENT_FORMS), default=default, required=default is None,
        help=f"form of a recording{f' (default {default})' if default else ''}",
    )  # fmt: skip
    return out


def make_folder(out: Path) -> None:
    """Create the folder of ``--out``.

    Raises:
        UsageError: it cannot be created.
    """
    with system_errors(UsageError, f"--out {out}: cannot be written"):
        make_output_folder(out)


def asked_spec(asked: argparse.Namespace) -> StreamSpec:
    """Return the spec that the flags state, with its warnings shown."""
    spec = StreamSpec.from_dict(spec_fields(asked) | {"recipe": recipe_setting(asked_recipe(asked), asked.set)})
    spec.recipe.warn()
    return spec


def asked_catalogue(asked: argparse.Namespace, spec: StreamSpec) -> Catalogue:
    """Open the corpus that the flags name, and show which videos cannot be used. Errors: :func:`open_shown`."""
    catalogue = open_shown(
        asked.video, list_file=asked.list, rows=asked.rows or "full", scene=spec.scene != "off",
        cache_dir=asked.cache_dir, kind=kind_from(vars(asked)),
    )  # fmt: skip
    for refusal in catalogue.refusals:
        show(f"cannot be used: {refusal}")
    return catalogue


def asked_remaker(asked: argparse.Namespace, spec: StreamSpec, arrays: tuple[str, ...]) -> Remaker:
    """Return what makes samples of the corpus. Errors: :func:`asked_catalogue` and :class:`Remaker`."""
    catalogue = asked_catalogue(asked, spec)
    path = quarantine_path(catalogue.source.name, asked.cache_dir)
    quarantine = read_quarantine(path) if asked.quarantine else Quarantine()
    quarantine.entries(asked.quarantine)  # before any work: whether there is such a snapshot
    return Remaker(catalogue, spec, arrays, quarantine, asked.quarantine)
