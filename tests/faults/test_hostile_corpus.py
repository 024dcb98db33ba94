"""A folder of files that strangers made, served for real: everything is refused or replaced with a reason, the workers
stay within bounds, and nothing outside the folder is opened by its own name. (A link in the folder is followed, as
SECURITY.md says: the trace shows it under the name that it has there.)"""

from __future__ import annotations

import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from bench.processes import peak_rss_bytes
from tests.clips import panned_luma, write_clip
from tests.packed import pack
from tests.server.corpus.test_archives import HOSTILE
from tests.server.video.test_hostile import PLAYLISTS
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_server.system.sandbox import can_confine

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("strace") is None, reason="no strace here to see what is opened"),
]

FUZZED = 30
WORKER_MIB = 400
SMALL = {"voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}


@pytest.fixture
def corpus(compiled: None, tmp_path: Path) -> Path:
    """Good clips, playlists that name a file outside, a link to another, clips with bytes changed or cut out; the same
    in an archive, and archives that are damaged or lead out.
    """
    folder, outside = tmp_path / "corpus", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    write_clip(outside / "named.mp4", panned_luma(60, 64, 80))
    (outside / "secret.txt").write_text("root:x:0:0\n" * 1000)
    for name, text in PLAYLISTS.items():
        (folder / name).write_text(text.format(clip=outside / "named.mp4"))
    (folder / "link.mp4").symlink_to(outside / "secret.txt")
    mjpeg = {"codec": "mjpeg", "pixel_format": "yuvj420p"}
    originals = []
    for suffix, options in (("mp4", {}), ("mkv", {}), ("avi", mjpeg)):
        originals.append(write_clip(tmp_path / f"short.{suffix}", panned_luma(60, 64, 80), **options).read_bytes())  # type: ignore[arg-type]
        for number in range(3):  # enough of them that a damaged clip finds a sound one in its place
            write_clip(folder / f"good{number}.{suffix}", panned_luma(240, 64, 80), **options)  # type: ignore[arg-type]
    rng = random.Random(0)
    for number in range(FUZZED):
        content = bytearray(originals[number % 3])
        for _ in range(rng.choice((1, 10, 200))):
            content[rng.randrange(len(content))] = rng.randrange(256)
        if number % 4 == 0:
            del content[rng.randrange(len(content)) :]
        elif number % 4 == 1:
            start = rng.randrange(len(content))
            del content[start : start + rng.randrange(2000)]
        (folder / f"fuzzed{number:02d}.{('mp4', 'mkv', 'avi')[number % 3]}").write_bytes(content)
    (tmp_path / "packed").mkdir()
    for path in [*folder.glob("good0.*"), *folder.glob("fuzzed0*")]:
        shutil.copy(path, tmp_path / "packed")
    for ending in ("tar", "zip"):
        pack(tmp_path / "packed", folder / f"packed {ending}.{ending}")
    (folder / "hostile").mkdir()
    for number, (ending, write, _) in enumerate(HOSTILE.values()):
        data = write(tmp_path / f"archive{ending}")
        (folder / "hostile" / f"{number}{ending}").write_bytes(data)
    return folder


def status(process: psutil.Process) -> str:
    return Path(f"/proc/{process.pid}/status").read_text()


def test_a_hostile_folder_is_served_within_bounds(corpus: Path, tmp_path: Path) -> None:
    log, port_file = tmp_path / "opened.txt", tmp_path / "port"
    flags = [f"{key}={value}" for key, value in SMALL.items()]
    server = subprocess.Popen(
        [
            *("strace", "-f", "-qq", "-e", "trace=openat,open", "-e", "signal=none", "-o", str(log)),
            *(sys.executable, "-m", "v2v_server", "--videos", str(corpus), "--workers", "1", "--list-refused"),
            *("--bind", "tcp://127.0.0.1:*", "--port-file", str(port_file), "--cache-dir", str(tmp_path / "cache")),
            *(part for flag in flags for part in ("--set", flag)),
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        until(lambda: port_file.exists() or server.poll() is not None)
        dataset = V2VStreamDataset(port_file.read_text().strip(), 1, rank=0, world_size=1, timeout_seconds=300.0)
        samples = [batch for _ in range(2) for batch in dataset]
        workers = [
            process
            for process in psutil.Process(server.pid).children(recursive=True)
            if "v2v_server.commands.worker" in process.cmdline()
        ]
        peaks = [peak_rss_bytes(worker.pid) / (1 << 20) for worker in workers]
        confined = [re.search(r"^Seccomp:\t2$", status(worker), re.MULTILINE) is not None for worker in workers]
    finally:
        for process in psutil.Process(server.pid).children(recursive=True):
            if "v2v_server" in process.cmdline() and "strace" not in process.cmdline()[0]:
                process.terminate()
        _, said = server.communicate(timeout=60)
    assert not can_confine().calls or all(confined)
    assert len(samples) >= 2 * 9 * 10  # of the good clips at least
    for batch in samples:
        assert batch.voxels.shape[1] == SMALL["voxels_per_clip"]
        assert batch.provenance[0].video not in PLAYLISTS
    assert peaks
    assert max(peaks) < WORKER_MIB, peaks
    for name in (*PLAYLISTS, "link.mp4"):
        assert re.search(rf"^  {re.escape(name)}: \S", said, re.MULTILINE), said
    opened = re.findall(r'open(?:at)?\([^"]*"([^"]+)"', log.read_text(errors="replace"))
    assert any(path.endswith("good0.mp4") for path in opened)  # the trace sees what is opened
    packed = {item.video.partition("/")[0] for batch in samples for item in batch.provenance}
    assert packed >= {"packed tar", "packed zip"}
    main, *_ = trace = log.read_text(errors="replace").splitlines()
    readers = {line.split()[0] for line in trace if "/hostile/" in line and re.search(r'\.(tar|zip)"', line)}
    assert len(readers) > 0, "the trace sees who opens archives"
    assert main.split()[0] not in readers, "the server's main process reads no table"
    assert re.search(r"^  hostile/\d+\.tar: is cut short", said, re.MULTILINE), said
    assert not [path for path in opened if "outside/" in path]
    assert "root:x" not in said
