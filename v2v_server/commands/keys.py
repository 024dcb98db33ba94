"""`v2v-keys`: manage the keys of a server that other machines can reach."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.keys import SIDES
from v2v_protocol.programs import show
from v2v_server.keys import KeyFolder


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-keys", "init|new|list|revoke [NAME] [flags]",
        "Create, list and revoke the keys by which a server recognises its consumers and workers. A running server "
        "applies changes at once; revoking a key also closes its open connections.",
        ["v2v-keys init", "v2v-keys new gpu1 --for consumer", "v2v-keys list", "v2v-keys revoke gpu1"],
    )  # fmt: skip
    keys = parser.group("Keys")
    keys.add_argument("action", choices=("init", "new", "list", "revoke"), help="what to do")
    keys.add_argument("name", nargs="?", metavar="NAME", help="name of the key, for new and revoke")
    keys.add_argument("--for", dest="side", choices=SIDES, help="side that will use the new key")
    keys.add_argument(
        "--dir", metavar="DIR", help="folder of the server's keys (default: v2v/keys in the user's configuration)"
    )
    keys.add_argument("--out", metavar="FILE", help="file for the new key, to be given to its user (default: NAME.key)")
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> None:
    configuration = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    path = Path(arguments.dir or Path(configuration, "v2v", "keys"))
    folder = KeyFolder(path)
    if arguments.action in ("new", "revoke") and arguments.name is None:
        raise UsageError(f"{arguments.action} needs the name of a key, as in v2v-keys {arguments.action} gpu1")
    if arguments.action == "init":
        folder.init()
        show(f"made {path}: v2v-serve --keys {path}")
    elif arguments.action == "new":
        if arguments.side is None:
            raise UsageError(f"new {arguments.name}: give the side that will use it, --for {' or --for '.join(SIDES)}")
        out = Path(arguments.out or f"{arguments.name}.key")
        folder.new(arguments.name, arguments.side, out)
        show(
            f"made {out} for a {arguments.side}: copy it there over a secure channel with mode 600, set V2V_KEYS to it"
        )
    elif arguments.action == "list":
        for side, names in folder.allowed().items():
            for public, name in names.items():
                show(f"{side:8}  {name:24}  {public}")
    else:
        show(f"revoked {arguments.name} ({', '.join(folder.revoke(arguments.name))})")


if __name__ == "__main__":
    sys.exit(main())
