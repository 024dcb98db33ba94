"""`v2v-doctor`: check the installation, the machine, the port and a corpus, and say of each what to change.

Missing packages are one of its findings, so it imports modules that need them only after it has checked.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import re
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from operator import itemgetter
from pathlib import Path

from packaging.requirements import Requirement

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import install_line, show, version_of
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import KindFlags, kind_from
from v2v_server.system.process import control_group_memory, usable_cores
from v2v_server.system.sandbox import can_confine

OK, NOTE, BAD = "ok", "note", "bad"
EXTRAS = ("server", "client", "trainer")
"""Extras of the distribution: where the videos are, where the GPU is, and there with the paper's networks."""
_EQUIVALENT = {"opencv-contrib-python-headless": ("opencv-python-headless", "opencv-contrib-python", "opencv-python")}
"""Packages that bring the same module; nothing that only the first one has is used."""
NEEDED_CODECS = ("h264", "hevc", "vp8", "vp9", "libdav1d", "mpeg4", "mjpeg", "libx264")
"""Decoders of usual videos, and the encoder of films."""
_GIB = 1 << 30
_LITTLE_MEMORY_BYTES = 1 << 30
_FEW_FILES = 4096
_TORCH = """
import json, torch
cuda = torch.cuda.is_available()
names = [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())] if cuda else []
print(json.dumps([torch.__version__, names]))
"""
_TORCH_SECONDS = 120.0


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        level: OK, NOTE (worth knowing) or BAD (in the way).
        about: what was checked.
        text: what was found.
        change: what to do; empty if nothing.
    """

    level: str
    about: str
    text: str
    change: str = ""


def run_checks(
    port: int, videos: str | None, recipe: str, rows: str, cache_dir: str | None, kind: VideosKind
) -> Iterator[Finding]:
    """Run all checks and yield each finding at once; arguments as of the command.

    Raises:
        UsageError: wrong recipe or rows.
    """
    yield Finding(OK, "version", f"{version_of('v2v-stream')}, Python {sys.version.split()[0]}, {sys.platform}")
    missing = {part: _missing(part) for part in EXTRAS}
    yield from _installation(missing)
    if not missing["server"]:
        yield from _libraries()
    if _is_here(Requirement("torch")):
        yield _torch()
    yield from _machine()
    yield _port(port)
    if videos is None:
        yield Finding(OK, "corpus", "not checked; --videos DIR checks one")
    elif missing["server"]:
        yield Finding(BAD, "corpus", "cannot be checked without the extra 'server'", install_line("server"))
    else:
        # Needs packages of that extra.
        corpus = importlib.import_module("v2v_tools.doctor.corpus")
        yield from (Finding(*line) for line in corpus.check_corpus(videos, recipe, rows, cache_dir, kind))


def _missing(part: str) -> list[str]:
    """List the requirements of an extra that are not installed, or of another version than it allows."""
    try:
        requirements = metadata.requires("v2v-stream") or []
    except metadata.PackageNotFoundError:
        return []
    wanting = []
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or not requirement.marker.evaluate({"extra": part}):
            continue
        if requirement.name == "v2v-stream":
            wanting += [name for extra in sorted(requirement.extras) for name in _missing(extra)]
        elif not _is_here(requirement):
            wanting.append(f"{requirement.name}{requirement.specifier}")
    return wanting


def _is_here(requirement: Requirement) -> bool:
    for name in (requirement.name, *_EQUIVALENT.get(requirement.name, ())):
        with suppress(metadata.PackageNotFoundError):
            return requirement.specifier.contains(metadata.version(name), prereleases=True)
    return False


def _installation(missing: dict[str, list[str]]) -> Iterator[Finding]:
    for part, names in missing.items():
        if not names:
            yield Finding(OK, part, "all required packages are installed")
        else:
            level = BAD if missing["server"] and missing["client"] and part != "trainer" else NOTE
            change = f"{install_line(part)}, if you need that part on this machine"
            # Name the packages only if no part works: this machine may not need the others.
            text = f"not installed or too old: {', '.join(names)}" if level == BAD else "not complete"
            yield Finding(level, part, text, change)


def _libraries() -> Iterator[Finding]:
    try:
        av, zmq, numba = (importlib.import_module(name) for name in ("av", "zmq", "numba"))
        importlib.import_module("cv2")
    except (ImportError, OSError) as error:
        change = "install the library it names with the system's package manager, or reinstall that Python package"
        yield Finding(BAD, "libraries", f"a package is installed and cannot be loaded: {error}", change)
        return
    ffmpeg = ".".join(map(str, av.library_versions["libavcodec"]))
    yield Finding(
        OK, "libraries",
        f"PyAV {av.__version__} (libavcodec {ffmpeg}), libzmq {zmq.zmq_version()}, numba {numba.__version__}",
    )  # fmt: skip
    absent = [name for name in NEEDED_CODECS if name not in av.codecs_available]
    if absent:
        change = "pip install --force-reinstall av, whose wheels bring FFmpeg with all of them"
        yield Finding(NOTE, "codecs", f"this FFmpeg lacks {', '.join(absent)}", change)
    else:
        yield Finding(OK, "codecs", ", ".join(NEEDED_CODECS))
    if not zmq.has("curve"):
        yield Finding(NOTE, "keys", "this libzmq has no CURVE: no connections with keys", "pip install pyzmq again")


def _torch() -> Finding:
    """Load torch in another process: loading takes seconds, and a wrong driver may end the process."""
    cards = _cards()
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TORCH], capture_output=True, text=True, timeout=_TORCH_SECONDS, check=False
        )
        version, names = json.loads(done.stdout.strip().splitlines()[-1])
    except (subprocess.TimeoutExpired, IndexError, ValueError):
        return Finding(BAD, "torch", "is installed and cannot be loaded", 'run python -c "import torch" to see why')
    if names:
        return Finding(OK, "torch", f"{version}; {', '.join(names)}")
    if cards:
        change = "install the build of torch for its driver's CUDA version (nvidia-smi shows it)"
        return Finding(BAD, "torch", f"{version} sees no GPU, though nvidia-smi lists {cards}", change)
    return Finding(NOTE, "torch", f"{version}, no GPU: networks train on the processor")


def _cards() -> str:
    with suppress(OSError, subprocess.TimeoutExpired):  # the first where there is no such program
        done = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30, check=False)
        if done.returncode == 0:
            return ", ".join(re.findall(r"^GPU \d+: ([^(\n]+?) *\(", done.stdout, re.M))
    return ""


def _machine() -> Iterator[Finding]:
    cores, all_cores = usable_cores(), os.cpu_count() or 1
    why = "" if cores == all_cores else f" of {all_cores}: affinity or a control group holds the rest back"
    yield Finding(OK, "cores", f"{cores}{why}; v2v-serve --workers {cores} keeps them busy")
    yield _memory()
    yield _sandbox()
    kernels = os.environ.get("NUMBA_CACHE_DIR", "")  # chosen when v2v_server was imported
    if kernels:
        yield Finding(OK, "kernels", f"compiled kernels are kept in {kernels}")
    else:
        change = "set V2V_CACHE_DIR to a writable folder"
        yield Finding(NOTE, "kernels", "no folder for compiled kernels: every start takes longer", change)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < _FEW_FILES:
        change = "ulimit -Hn 65536, LimitNOFILE= of systemd, or docker run --ulimit nofile=65536"
        yield Finding(NOTE, "open files", f"at most {hard}: too few for many consumers and workers", change)
    else:
        yield Finding(OK, "open files", "no limit" if hard == resource.RLIM_INFINITY else f"up to {hard}")


def _memory() -> Finding:
    limits: list[tuple[float, int]] = [*control_group_memory()]
    with suppress(OSError):
        found = re.search(r"^MemAvailable: +(\d+) kB", Path("/proc/meminfo").read_text(encoding="ascii"), re.M)
        limits += [(math.inf, 1024 * int(found[1]))] if found else []
    if not limits:
        return Finding(NOTE, "memory", "this system does not report free memory")
    limit, free = min(limits, key=itemgetter(1))
    text = f"{free / _GIB:.1f} GiB free"
    if limit < math.inf:
        text += f"; the control group's limit is {limit / _GIB:.1f} GiB"
    if free < _LITTLE_MEMORY_BYTES:
        return Finding(BAD, "memory", text, "free memory or raise the limit: a server and one worker need about 1 GiB")
    return Finding(OK, "memory", text)


def _sandbox() -> Finding:
    can = can_confine()
    lacking = [name for name, has in (("seccomp", can.calls), ("Landlock", can.files)) if not has]
    if not lacking:
        return Finding(OK, "sandbox", "processes that decode videos cannot start programs or open other files")
    text = f"no {' and no '.join(lacking)} here: a video that exploits a decoder gets more of its user's rights"
    return Finding(NOTE, "sandbox", text, "serve untrusted videos from a container, or with deploy/systemd")


def _port(port: int) -> Finding:
    try:
        with socket.socket() as taker:
            taker.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            taker.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        change = f"a server may be running already; otherwise give v2v-serve --bind tcp://127.0.0.1:{port % 60000 + 1}"
        return Finding(NOTE, "port", f"{port} cannot be taken: {getattr(error, 'strerror', None) or error}", change)
    return Finding(OK, "port", f"{port} is free")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-doctor", "[--videos DIR] [flags]",
        "Check this machine, this installation and a corpus, and say what to change.",
        ["v2v-doctor --videos webvid10k/", "v2v-doctor --videos webvid10k/ --recipe davis346-measured --port 6000"],
        "Exit status: 0 no problems found, 1 problems found.",
    )  # fmt: skip
    what = parser.group("What to check")
    what.add_argument("--videos", metavar="DIR", help="also check a folder of videos, a video or a list file")
    what.add_argument(
        "--recipe", metavar="NAME", default="paper", help="recipe to check the videos against (default paper)"
    )
    what.add_argument("--port", type=int, default=5555, metavar="N", help="port that a server would use (default 5555)")
    what.add_argument("--rows", default="full", metavar="ROWS", help="rows to use: full (default), top:0.54 (WebVid)")
    what.add_argument("--cache-dir", metavar="DIR", help="folder of the catalogue index (default: the user's cache)")
    parser.add_settings(KindFlags)
    return run_command(parser, _run, argv, failures=(V2VError,))


def _run(arguments: argparse.Namespace) -> int:
    if not 1 <= arguments.port <= 65535:
        raise UsageError(f"--port {arguments.port}: give 1 to 65535")
    found_bad = has_defects = False
    for finding in run_checks(
        arguments.port, arguments.videos, arguments.recipe, arguments.rows, arguments.cache_dir,
        kind_from(vars(arguments)),
    ):  # fmt: skip
        found_bad = found_bad or finding.level == BAD
        has_defects = has_defects or (finding.level, finding.about) == (NOTE, "pictures")
        show(f"{finding.level:4}  {finding.about:12}  {finding.text}")
        if finding.change:
            show(f"{'':20}-> {finding.change}")
    if found_bad:
        show("problems found: see the lines that begin with bad")
    elif has_defects:
        show("the videos can be served, but their pictures have defects: see the notes about pictures")
    else:
        show("no problems found")
    return FAILED if found_bad else 0


if __name__ == "__main__":
    sys.exit(main())
