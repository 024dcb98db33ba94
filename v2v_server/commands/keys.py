"""`v2v-keys`: who may talk to a server that other machines can reach."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.keys import SIDES
from v2v_server.keys.folder import KeyFolder


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = Parser(
        "v2v-keys", "init|new|list|revoke [NAME] [flags]",
        "Make, list and revoke the keys by which a server knows its consumers and workers. A running server takes up "
        "what changes at once; a revoked key loses its open connections too.",
        ["v2v-keys init", "v2v-keys new gpu1 --for consumer", "v2v-keys list", "v2v-keys revoke gpu1"],
    )  # fmt: skip
    keys = parser.group("Keys")
    keys.add_argument("action", choices=("init", "new", "list", "revoke"), help="what to do")
    keys.add_argument("name", nargs="?", metavar="NAME", help="of the key, for new and revoke")
    keys.add_argument("--for", dest="side", choices=SIDES, help="who will use the new key")
    keys.add_argument("--dir", metavar="DIR", help="the server's keys (default: v2v/keys in the user's configuration)")
    keys.add_argument("--out", metavar="FILE", help="the new key's file, to be given to its user (default: NAME.key)")
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> None:
    path = Path(arguments.dir) if arguments.dir else _default_folder()
    folder = KeyFolder(path)
    if arguments.action in ("new", "revoke") and arguments.name is None:
        raise UsageError(f"{arguments.action}: say which key, as in v2v-keys {arguments.action} gpu1")
    if arguments.action == "init":
        folder.init()
        print(f"made {path}: v2v-serve --keys {path}")
    elif arguments.action == "new":
        if arguments.side is None:
            raise UsageError(f"new {arguments.name}: say who will use it, --for {' or --for '.join(SIDES)}")
        out = Path(arguments.out or f"{arguments.name}.key")
        folder.new(arguments.name, arguments.side, out)
        print(
            f"made {out} for a {arguments.side}: copy it there over a safe way, keep its mode 600, set V2V_KEYS to it"
        )
    elif arguments.action == "list":
        for side, names in folder.allowed().items():
            for public, name in names.items():
                print(f"{side:8}  {name:24}  {public}")
    else:
        print(f"revoked {arguments.name} ({', '.join(folder.revoke(arguments.name))})")


def _default_folder() -> Path:
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config", "v2v", "keys")


if __name__ == "__main__":
    sys.exit(main())
