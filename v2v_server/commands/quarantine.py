"""`v2v-quarantine`: list what is in quarantine, or clear it into a new snapshot.

Servers may run meanwhile: the file numbers every snapshot under a lock. A running server continues under the lines that
it has read. It learns of a clearing with its next entry or at its next start.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import V2VError
from v2v_protocol.programs import show
from v2v_protocol.write_aside import JSON, write_json
from v2v_server.corpus.sources.source import SourceOptions, open_source
from v2v_server.quarantine import Quarantine, clearing, quarantine_path, read_quarantine, write_entry


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-quarantine", "--videos DIR [flags]",
        "List the sequences and videos that crashed or hung workers, or clear the list.",
        ["v2v-quarantine --videos webvid10k/", "v2v-quarantine --videos webvid10k/ --clear"],
    )  # fmt: skip
    what = parser.group("Quarantine")
    what.add_argument("--videos", required=True, metavar="DIR", help="the corpus, as for v2v-serve")
    what.add_argument("--cache-dir", metavar="DIR", help="folder of the catalogue index (default: the user's cache)")
    what.add_argument("--clear", action="store_true", help="start a new, empty snapshot; old ones stay available")
    parser.add_output("Quarantine", "--json", JSON, "also write all entries to a file, and whether each is in force")
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> None:
    source = open_source(arguments.videos, SourceOptions(cache_dir=arguments.cache_dir))
    file = quarantine_path(source.name, arguments.cache_dir)
    quarantine = read_quarantine(file)
    if arguments.clear and quarantine.entries(quarantine.latest):
        _clear(file, quarantine)
    in_force = quarantine.entries(quarantine.latest)
    for line in quarantine.lines:
        show(f"{'in force' if line in in_force else 'not now ':8}  {line}")
    show(f"snapshot {quarantine.latest} holds {len(in_force)} entries ({file})")
    if arguments.json is not None:
        records = [asdict(line) | {"in_force": line in in_force} for line in quarantine.lines]
        write_json(arguments.json, records)


def _clear(file: Path, quarantine: Quarantine) -> None:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        quarantine.extend(write_entry(file, clearing(now), quarantine))
    except OSError as error:
        raise V2VError(f"quarantine file {file} cannot be written: {error.strerror}; nothing was cleared") from error


if __name__ == "__main__":
    sys.exit(main())
