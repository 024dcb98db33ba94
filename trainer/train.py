"""``v2v-train``: train a network on the stream."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import torch

from trainer.config import StreamConfig, TrainConfig, keys
from trainer.config_file import load_config, shipped, show_config
from trainer.feed import flags_of
from trainer.learner import build, obeying_weights
from trainer.loop import Diverged, train
from trainer.run import data, export
from trainer.run.checkpoint import (
    LAST,
    Checkpoint,
    load_checkpoint,
    numerics_of,
    require_fresh,
    require_same_run,
    require_writable,
)
from trainer.run.distributed import Ranks, ranks
from trainer.run.interruption import StopRequest
from trainer.run.reporting import CONFIGURATION
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import counted
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import array_layout
from v2v_protocol.spec import StreamSpec
from v2v_protocol.write_aside import check_outside

SIGNAL_STATUS = 128


def _parser() -> Parser:
    parser = Parser(
        "v2v-train", "CONFIG.yaml [flags]",
        "Train a network on the stream. Without an address it starts its own server. Ctrl-C and SIGTERM end the run "
        "after the current step and save it; a second signal ends it at once (under torchrun a third).",
        [
            "v2v-train e2vid --videos webvid10k/ --workers 8 --out runs/e2vid",
            "v2v-train my.yaml --connect tcp://127.0.0.1:5555 --set optimizer.learning_rate=1e-4",
            "torchrun --nproc-per-node 4 -m trainer.train e2vid --connect tcp://head:5555",
            "v2v-train data firenet-cpu",
            "v2v-train export --help",
        ],
        "Exit status: 0 trained to the end, 1 diverged, 2 wrong usage or input, full disk or no server, 128 + N ended "
        f"and saved after signal N.\nShipped configurations: {', '.join(shipped())}.\nKeys: {keys()}",
    )  # fmt: skip
    stream = parser.group("Stream")
    source = stream.add_mutually_exclusive_group()
    source.add_argument(
        "--connect", metavar="ADDRESS", help="address of a running server, or several with commas (stream.address)"
    )
    source.add_argument("--videos", metavar="DIR", help="start a server on these videos (stream.videos)")
    stream.add_argument("--workers", type=int, metavar="N", help="number of workers of that server (stream.workers)")
    run = parser.group("Run")
    run.add_argument("config", metavar="CONFIG.yaml", help="a file, or the name of a shipped configuration")
    run.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="set one key; repeatable"
    )
    run.add_argument("--resume", metavar="FILE", help="checkpoint to continue from")
    run.add_argument(
        "--out", metavar="DIR",
        help="folder of the run (run.out; default runs/NAME of CONFIG, with --resume the folder of the checkpoint)",
    )  # fmt: skip
    run.add_argument("--show-config", action="store_true", help="print all keys with their values and exit")
    return parser


def _settings(arguments: argparse.Namespace) -> list[str]:
    """Return the flags as settings, after those of ``--set``."""
    given = {
        "stream.address": "" if arguments.videos else arguments.connect,
        "stream.videos": arguments.videos,
        "stream.workers": arguments.workers,
        "run.out": arguments.out,
    }
    flags = [f"{key}={json.dumps(value)}" for key, value in given.items() if value is not None]
    return [*arguments.settings, *flags]


def require_servable(config: TrainConfig, out: Path, mine: Ranks) -> None:
    """Check, before any server starts, that one can be started for each stream without an address.

    Args:
        out: folder of the run.

    Raises:
        UsageError: a stream has no videos, its list is missing, the ranks run on several hosts, or the folder lies in
            the videos.
    """
    for name, (stream, _) in config.stream.mixed.items():
        if stream.address:
            continue
        if not stream.videos:
            raise UsageError(f"{name}.videos is missing: give --videos DIR, or --connect ADDRESS of a running server")
        if not os.path.exists(stream.videos) and "://" not in stream.videos:
            raise UsageError(
                f"{name}.videos = {stream.videos}: there is no such folder, video or list file on this host"
            )
        if stream.list and not Path(stream.list).is_file():
            raise UsageError(
                f"{name}.list {stream.list}: no such file; --set stream.list=FILE names it, or --set stream.list= for "
                "all videos"
            )
        if mine.hosts > 1:
            raise UsageError(
                f"ranks on {mine.hosts} hosts: start v2v-serve yourself and give all ranks --connect ADDRESS"
            )
        check_outside("--out", out, [stream.videos], "films")


@contextmanager
def serving(stream: StreamConfig, recipe: Recipe, mine: Ranks) -> Iterator[str]:
    """Yield the address to connect to; if none is configured, of a server that runs until the block ends.

    Raises:
        UsageError: the server of rank 0 did not start.
        ServerLost: the server did not start.
    """
    if stream.address:
        yield stream.address
        return
    if not mine.first:
        address, error = mine.from_first(None)
        if error:
            raise UsageError(f"rank 0 could not start a server: {error}")
        yield address
        return
    # The server's output is not shown, and cataloguing a new corpus takes a while.
    print(
        f"starting a server: {stream.videos}, rows {stream.rows}, {counted(stream.workers, 'worker')}", file=sys.stderr
    )
    with ExitStack() as stack:
        try:
            server = LocalServer(stream.videos, workers=stream.workers, flags=flags_of(stream, recipe))
            stack.enter_context(server)
        except V2VError as error:
            mine.from_first(("", str(error)))
            raise
        mine.from_first((server.address, ""))
        yield server.address


def _lacks_bfloat16() -> bool:
    # PyTorch reports "AVX512", or the name of another architecture, where there may be native bfloat16.
    return torch.backends.cpu.get_cpu_capability() == "AVX2"


def _trained(config: TrainConfig, mine: Ranks, out: Path, resume: Checkpoint | None) -> tuple[int, int]:
    """Train; return the steps so far, and the signal that ended the run or 0. The learner is freed on return."""
    require_servable(config, out, mine)
    learner = build(config, mine)
    forms = {
        name: array_layout(
            learner.task.asked.recipe(stream.resolved_recipe),
            StreamSpec.from_dict(dict(stream.spec)).voxel_dtype,
            learner.task.asked.arrays,
        )
        for name, (stream, _) in config.stream.mixed.items()
    }
    for name, form in forms.items():
        if form != forms["stream"]:
            raise UsageError(
                f"{name}: its samples are {form}, those of stream are {forms['stream']}; give recipes of one size, and "
                "one voxel_dtype"
            )
    if mine.first:
        require_writable(out)
    with ExitStack() as stack:
        addresses = [
            stack.enter_context(serving(stream, learner.task.asked.recipe(stream.resolved_recipe), mine))
            for stream, _ in config.stream.mixed.values()
        ]
        stop = stack.enter_context(StopRequest(config.run.seconds, mine.any))
        steps = train(config, learner, addresses, mine, stop, out, resume)
    return steps, stop.signal


def run(arguments: argparse.Namespace) -> int:
    """Run one training; return the exit status.

    Raises:
        V2VError: see :func:`load_config`, :func:`trainer.learner.build` and :func:`trainer.loop.train`.
    """
    resume = None if arguments.resume is None else load_checkpoint(arguments.resume)
    config = load_config(arguments.config, _settings(arguments), None if resume is None else numerics_of(resume))
    if arguments.show_config:
        print(show_config(config), end="")
        return 0
    if resume is None:
        config = obeying_weights(config)
        out = Path(config.run.out or f"runs/{Path(arguments.config).stem}")
        require_fresh(out)
        if (out / CONFIGURATION).resolve() == Path(arguments.config).resolve():
            raise UsageError(f"--out {out}: the run would replace {arguments.config}; give another folder")
    else:
        # Not the default folder of the configuration, which may hold another run.
        begun_in = Path(arguments.resume).parent
        out = Path(config.run.out or begun_in)
        if out.resolve() != begun_in.resolve():
            require_fresh(out)
        config = config.with_network_options(resume.config["network"]["options"], weights="")
        for change in require_same_run(resume, config):
            print(f"v2v-train: changed since the checkpoint: {change}", file=sys.stderr)
    if config.compute.threads:
        torch.set_num_threads(config.compute.threads)
    with ranks(config.compute.device, config.compute.group_timeout_seconds) as mine:
        if config.compute.precision == "bfloat16" and mine.device.type == "cpu" and _lacks_bfloat16():
            print(
                "v2v-train: warning: this processor has bfloat16 in software only, nine times slower than float32; use "
                "--set compute.precision=float32",
                file=sys.stderr,
            )
        steps, signal = _trained(config, mine, out, resume)
        if mine.first:
            why = f"ended by signal {signal}" if signal else "done"
            print(f"{why} after step {steps}: {out / LAST}")
    return SIGNAL_STATUS + signal if signal else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status. ``export`` and ``data`` are commands of their own."""
    given = sys.argv[1:] if argv is None else argv
    for word, other in (("export", export.main), ("data", data.main)):
        if given[:1] == [word]:
            return other(given[1:])
    return run_command(_parser(), run, argv, failures=(Diverged,), interrupted="interrupted before the first step")


if __name__ == "__main__":
    sys.exit(main())
