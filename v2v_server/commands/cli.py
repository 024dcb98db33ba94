"""The command lines of the server: arguments -> configuration -> call.

Exit status: 0 success, 1 the command could not do its work, 2 wrong usage or input, 130 interrupted. Errors are one
line on stderr; `--debug` shows the trace.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.recipe import PRESETS
from v2v_protocol.sample import ARRAYS, DEFAULT_ARRAYS
from v2v_protocol.spec import (
    FLOW_DIRECTIONS,
    FLOW_METHODS,
    ON_BAD_VIDEO,
    SCENES,
    SPEED_PRESETS,
    VOXEL_DTYPES,
)
from v2v_server.catalogue.files import corpus_root
from v2v_server.config import DEFAULT_BIND, ServeConfig, recipe_setting


def serve(argv: Sequence[str] | None = None) -> None:
    """`v2v-serve`."""
    parser = new_parser("v2v-serve", "Decode videos, simulate event voxels, stream samples to trainers.")
    parser.add_argument(
        "--videos", metavar="DIR", help="folder of videos (searched recursively), a video, or a list file"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="local worker processes (default 2)")
    parser.add_argument(
        "--expect-workers",
        type=int,
        metavar="N",
        help="workers that will serve in all, other hosts' too (default the local ones): a consumer's credit is "
        "settled for them when it connects, up to 400 samples and --max-credit-bytes",
    )
    parser.add_argument("--config", metavar="FILE", help="YAML file of these settings; a flag wins over it")
    parser.add_argument("--list", metavar="FILE", help="list file (`path frames c+ c-`) that restricts --videos")
    parser.add_argument(
        "--rows", metavar="ROWS", help="rows to use: full (default), top:0.54 (WebVid), top:180px, 0.1:0.6"
    )
    parser.add_argument(
        "--bind", metavar="ADDRESS", help=f"address for consumers (default {DEFAULT_BIND}; port * is a free one)"
    )
    parser.add_argument("--worker-bind", metavar="ADDRESS", help="address for workers (default: private to this host)")
    parser.add_argument(
        "--insecure", action="store_true", default=None, help="allow addresses other machines can reach"
    )
    parser.add_argument("--port-file", metavar="FILE", help="receives the bound address once the server is ready")
    parser.add_argument("--cache-dir", metavar="DIR", help="folder of the catalogue index (default: the user's cache)")
    parser.add_argument(
        "--list-refused", action="store_true", default=None, help="name every video that cannot be used, not only five"
    )
    _add_spec(parser)
    parser.add_argument(
        "--lease-deadline-seconds", type=float, metavar="S", help="a worker silent for longer hangs (60)"
    )
    parser.add_argument(
        "--session-idle-seconds", type=float, metavar="S", help="forget consumers silent for longer (600)"
    )
    parser.add_argument("--max-credit-bytes", type=int, metavar="N", help="bytes in flight to one consumer (2 GiB)")
    parser.add_argument("--parent-pid", type=int, help=argparse.SUPPRESS)

    def run(arguments: argparse.Namespace) -> None:
        from v2v_server.serve import serve as run_server

        flags = {name: value for name, value in vars(arguments).items() if name not in ("debug", "config", "set")}
        # Without --recipe the fields of --set are changed in what the file says.
        settings = arguments.set if arguments.recipe is None else []
        if arguments.recipe is not None:
            flags["recipe"] = recipe_setting(arguments.recipe, arguments.set)
        run_server(ServeConfig.load(arguments.config, flags, settings))

    run_command(parser, run, argv)


def worker(argv: Sequence[str] | None = None) -> None:
    """`v2v-worker`."""
    parser = new_parser("v2v-worker", "Work for a server: take leases, make samples.")
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="where the server listens for workers")
    parser.add_argument("--videos", required=True, metavar="DIR", help="the corpus on this host: what the server's is")
    parser.add_argument("--name", help="how its name begins in logs (default: host and process id)")
    parser.add_argument("--parent-pid", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--logbook-fd", type=int, help=argparse.SUPPRESS)

    def run(arguments: argparse.Namespace) -> None:
        from v2v_server.worker.conversation import run_worker, unshared_name

        # Its own workers a server names itself, and knows them by it.
        name = arguments.name if arguments.logbook_fd is not None else unshared_name(arguments.name)
        run_worker(
            arguments.connect, corpus_root(Path(arguments.videos)), name, arguments.parent_pid, arguments.logbook_fd
        )

    run_command(parser, run, argv)


def simulate(argv: Sequence[str] | None = None) -> None:
    """`v2v-simulate`."""
    parser = new_parser("v2v-simulate", "Make one sample in this process: the same bytes a server would stream.")
    parser.add_argument("video", metavar="VIDEO", help="a video; or a folder or list file, to remake a streamed sample")
    parser.add_argument(
        "--out", required=True, metavar="FILE.npz", help="receives voxels, frames and provenance (JSON)"
    )
    parser.add_argument("--picture", metavar="FILE.png", help="also draw frames and voxels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--epoch", type=int, default=0)
    parser.add_argument("--index", type=int, default=0, help="global index in the epoch")
    parser.add_argument(
        "--quarantine",
        type=int,
        default=0,
        metavar="N",
        help="snapshot the sample was made under (its provenance says)",
    )
    parser.add_argument("--cache-dir", metavar="DIR", help="folder of catalogue index and quarantine, as the server's")
    parser.add_argument("--list", metavar="FILE", help="list file that restricts a folder")
    parser.add_argument("--rows", default="full", metavar="ROWS", help="rows to use: full (default), top:0.54 (WebVid)")
    parser.add_argument("--arrays", default=",".join(DEFAULT_ARRAYS), help=f"comma separated, of {','.join(ARRAYS)}")
    _add_spec(parser)

    def run(arguments: argparse.Namespace) -> None:
        from v2v_server.offline.remake import simulate_to_file

        simulate_to_file(
            arguments.video,
            out=Path(arguments.out),
            picture=None if arguments.picture is None else Path(arguments.picture),
            list_file=arguments.list,
            rows=arguments.rows,
            spec={name: getattr(arguments, name) for name in _SPEC_FLAGS}
            | {"recipe": recipe_setting(arguments.recipe, arguments.set)},
            arrays=tuple(arguments.arrays.split(",")),
            seed=arguments.seed,
            epoch=arguments.epoch,
            index=arguments.index,
            snapshot=arguments.quarantine,
            cache_dir=arguments.cache_dir,
        )

    run_command(parser, run, argv)


def new_parser(name: str, description: str) -> argparse.ArgumentParser:
    """A parser with what all commands have."""
    parser = argparse.ArgumentParser(prog=name, description=description)
    parser.add_argument("--debug", action="store_true", help="show the trace of an error")
    return parser


_SPEC_FLAGS = (
    "preset", "voxel_dtype", "shuffle", "max_sequences_per_video", "on_bad_video",
    "samples_per_decode", "sibling_spacing",
    "flow_method", "flow_direction", "flow_from", "flow_margin_px", "scene",
)  # fmt: skip


def _add_spec(parser: argparse.ArgumentParser) -> None:
    """Flags for what a stream is made of: the same for a server's defaults and for remaking one of its samples."""
    parser.add_argument("--preset", choices=tuple(SPEED_PRESETS), help="speed against accuracy (default exact)")
    parser.add_argument("--recipe", metavar="NAME", help=f"preset ({', '.join(PRESETS)}) or YAML file of recipe fields")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one recipe field, e.g. voxels_per_clip=5",
    )
    parser.add_argument("--voxel-dtype", choices=VOXEL_DTYPES, help="default int8: saturating, and counted")
    parser.add_argument("--no-shuffle", dest="shuffle", action="store_false", default=None, help="catalogue order")
    parser.add_argument("--max-sequences-per-video", type=int, metavar="N", help="per epoch (default 10)")
    parser.add_argument("--on-bad-video", choices=ON_BAD_VIDEO, help="default substitute")
    parser.add_argument("--samples-per-decode", type=int, metavar="K", help="samples made from each decoded clip (1)")
    parser.add_argument(
        "--sibling-spacing", type=int, metavar="S", help="how far apart those are (default: one batch of the consumer)"
    )
    parser.add_argument("--flow-method", choices=FLOW_METHODS, help="where flow is asked for (default auto)")
    parser.add_argument("--flow-direction", choices=FLOW_DIRECTIONS, help="default forward")
    parser.add_argument("--flow-from", type=int, metavar="T", help="first voxel whose flow is computed (default 0)")
    parser.add_argument("--flow-margin-px", type=int, metavar="N", help="picture around the crop (64; -1: all of it)")
    parser.add_argument(
        "--scene", choices=SCENES, help="auto: decode all once, leave out cuts, spare flow (default off)"
    )


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], None],
    argv: Sequence[str] | None,
    *,
    interrupted: str = "",
) -> None:
    """Runs a command; an error of ours becomes one line on stderr and an exit status.

    Args:
        parser: from :func:`new_parser`.
        run: does the work.
        argv: the command line; None takes that of the process.
        interrupted: what to say of a Ctrl-C; nothing if empty.

    Raises:
        SystemExit: 1 after an error, 2 after one of usage (argparse's too), 130 after a Ctrl-C.
    """
    arguments = parser.parse_args(argv)
    try:
        run(arguments)
    except KeyboardInterrupt:
        if interrupted:
            print(f"{parser.prog}: {interrupted}", file=sys.stderr)
        sys.exit(130)
    except V2VError as error:
        if arguments.debug:
            raise
        print(f"{parser.prog}: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, UsageError) else 1)


_COMMANDS = {"serve": serve, "worker": worker, "simulate": simulate}

if __name__ == "__main__":
    _COMMANDS[sys.argv[1]](sys.argv[2:])
