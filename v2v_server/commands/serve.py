"""`v2v-serve`: arguments -> configuration -> call."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import INTERRUPTED, Parser, run_command
from v2v_protocol.errors import V2VError
from v2v_protocol.spec_flags import add_spec, asked_recipe, recipe_setting
from v2v_protocol.write_aside import check_output, check_outside
from v2v_server.config import SERVE_KEYS, ServeConfig
from v2v_server.kinds.registry import KindFlags
from v2v_server.supervise.local_host import start_ahead
from v2v_server.system.log import report_errors


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-serve", "--videos DIR [flags]", "Decode videos, simulate event voxels, stream samples to trainers.",
        [
            "v2v-serve --videos clips/ --workers 8",
            "v2v-serve --videos webvid10k/ --rows top:0.54 --preset fast --scene auto",
            "v2v-serve --videos clips/ --recipe davis346-measured --set voxels_per_clip=20 --set 'threshold=[0.2,0.4]'",
            "v2v-serve --config serve.yaml",
        ],
        "Exit status: 0 ended by SIGTERM, 130 by Ctrl-C; a second signal ends it at once, without a summary.",
    )  # fmt: skip
    parser.add_settings(ServeConfig)
    parser.add_settings(KindFlags)
    add_spec(parser)
    parser.group("Videos").add_argument("--config", metavar="FILE", help="YAML file of these flags; a flag wins")
    return run_command(parser, report_errors(_run), argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> int:
    flags = {name: getattr(arguments, name) for name in SERVE_KEYS}
    # Without --recipe, --set changes fields of the file's recipe.
    recipe = asked_recipe(arguments)
    settings = arguments.set if recipe is None else []
    if recipe is not None:
        flags["recipe"] = recipe_setting(recipe, arguments.set)
    config = ServeConfig.load(arguments.config, flags, settings)
    arguments.log_format = config.log_format  # the file may ask for JSON
    if config.port_file:
        port_file = Path(config.port_file)
        read = [config.videos, config.list, arguments.config or ""]
        check_output("--port-file", port_file, (port_file.suffix.lower(),), read)
    check_outside("--cache", config.cache, [config.videos], "files")
    with start_ahead(config) as standbys:
        from v2v_server.serve import serve  # takes as long as the imports of a worker, which run meanwhile

        return INTERRUPTED if serve(config, standbys, arguments.debug) == signal.SIGINT else 0


if __name__ == "__main__":
    sys.exit(main())
