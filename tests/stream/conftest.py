"""A folder of small real video files, and servers over it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
from torch.utils.data import DataLoader

from tests.clips import damaged, panned_luma, write_clip
from tests.digests.clips import write_recordings
from v2v_client import Batch, V2VDataset, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.recipe import Recipe, preset
from v2v_server.corpus.catalogue import open_catalogue

SMALL = Recipe(voxels_per_clip=4, bins=5, crop_height_px=32, crop_width_px=40)
"""Needs 21 frames; everything else as in the paper."""
SMALL_FLAGS = ("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40")
"""The same for a server: it refuses to start when its own recipe gives no sequence."""


@pytest.fixture(scope="package", autouse=True)
def _patient_consumers() -> Iterator[None]:
    """Let consumers wait ten minutes for a sample: on a busy host, a worker takes longer than one minute to start."""
    defaults: Any = V2VStreamDataset.__init__.__kwdefaults__
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(defaults, "timeout_seconds", 600.0)
        yield


@pytest.fixture(scope="session")
def clips(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven clips in several codecs and folders: 25 sequences under SMALL."""
    folder = tmp_path_factory.mktemp("clips")
    (folder / "deep" / "er").mkdir(parents=True)
    for number, (name, frames, options) in enumerate(
        (
            ("a.mp4", 90, {"gop": 30, "b_frames": 2}),
            ("b.mkv", 64, {"gop": 12}),
            ("deep/c.mp4", 101, {"codec": "libx265", "gop": 25, "options": {"x265-params": "log-level=none"}}),
            ("deep/d.webm", 61, {"codec": "libvpx-vp9", "gop": 20}),
            ("deep/er/e.mov", 121, {"pixel_format": "yuv444p", "gop": 40}),
            ("deep/er/f.mp4", 45, {"gop": 45, "audio": True}),
            ("deep/er/g.avi", 70, {"codec": "mpeg4", "gop": 15}),
        )
    ):
        luma = panned_luma(frames, 48, 64, step=(1 + number % 2, 1 + number % 3))
        write_clip(folder / name, luma, **options)  # type: ignore[arg-type]
    open_catalogue(folder, processes=0).close()  # a server that finds no index starts processes that probe
    return folder


@pytest.fixture(scope="package")
def server(request: pytest.FixtureRequest, clips: Path) -> Iterator[LocalServer]:
    """A server over these clips for tests that leave it as it is. Of network faults, one worker shows all."""
    workers = 1 if request.node.name.endswith("faults") else 2
    with LocalServer(clips, workers=workers, flags=SMALL_FLAGS) as running:
        yield running


class Corpus(NamedTuple):
    """Videos of a kind, flags of their server, a recipe that they give sequences of, and one of them."""

    folder: Path
    one: str
    kind: str = "videos"
    flags: tuple[str, ...] = SMALL_FLAGS
    recipe: Recipe = SMALL


RECORDED = preset("recordings").replace(voxels_per_clip=2, crop_height_px=32, crop_width_px=40)


@pytest.fixture(scope="session", params=["videos", "recordings"])
def corpus(request: pytest.FixtureRequest, clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Corpus:
    """Videos of each kind whose samples are made of what a file holds."""
    if request.param == "videos":
        return Corpus(clips, "deep/c.mp4")
    folder = write_recordings(tmp_path_factory.mktemp("recordings") / "prepared")
    flags = ("--videos-kind", "recordings", "--preset", "recordings", *SMALL_FLAGS, "--set", "voxels_per_clip=2")
    return Corpus(folder, "a.v2ve", "recordings", flags, RECORDED)


@pytest.fixture(scope="session")
def clips_with_a_broken_one(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four good clips and one with garbage in the middle, which its container does not know of."""
    folder, aside = tmp_path_factory.mktemp("mixed"), tmp_path_factory.mktemp("aside")
    for number in range(4):
        write_clip(folder / f"good{number}.mp4", panned_luma(64, step=(1, 1 + number)), gop=16)
    write_clip(aside / "whole.mp4", panned_luma(126), gop=126)
    damaged(aside / "whole.mp4", folder / "broken.mp4", 50)
    open_catalogue(folder, processes=0).close()
    return folder


@pytest.fixture(autouse=True)
def _no_process_left() -> Iterator[None]:
    """Check that each process that a test started has ended; kill the others, so that the next test starts without.

    A server that more than one test uses may have new workers.
    """
    before = set(psutil.Process().children(recursive=True))
    yield
    started = {each: _described(each) for each in set(psutil.Process().children(recursive=True)) - before}
    of_servers = tuple(f"{process.pid} " for process in before)
    left = [
        each for each, text in started.items() if not text.startswith(of_servers) and "resource_tracker" not in text
    ]
    _, alive = psutil.wait_procs(left, timeout=60)
    for process in alive:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    assert not alive


def server_workers(pid: int) -> list[psutil.Process]:
    """The worker processes of a server (it has other helpers, which come and go)."""
    return [child for child in psutil.Process(pid).children() if "v2v_server.commands.worker" in _described(child)]


def _described(process: psutil.Process) -> str:
    """Return the id of its parent and its command line; "" if it has ended."""
    try:
        return f"{process.ppid()} {' '.join(process.cmdline())}"
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return ""


def digest(batch: Batch) -> str:
    """Of the identities and all bytes of a batch, provenance included."""
    sha = hashlib.sha256(repr((batch.epoch, batch.indices)).encode())
    sha.update(batch.voxels.numpy().tobytes())
    sha.update(batch.frames.numpy().tobytes())
    for provenance in batch.provenance:
        sha.update(repr(provenance.to_dict()).encode())
    return sha.hexdigest()


def epoch_of(
    address: str,
    *,
    seed: int = 3,
    epoch: int = 0,
    batch_size: int = 3,
    shared_memory: bool = True,
    compress: bool = False,
    recipe: Recipe = SMALL,
) -> list[Batch]:
    """All batches of one epoch."""
    dataset = V2VStreamDataset(
        address,
        batch_size=batch_size,
        recipe=recipe,
        seed=seed,
        epoch=epoch,
        shared_memory=shared_memory,
        compress=compress,
    )
    return list(dataset)


def made_here(videos: Path, *epochs: int, recipe: Recipe = SMALL, kind: str = "videos") -> list[Batch]:
    """All batches of these epochs, made in this process."""
    dataset = V2VDataset(videos, recipe=recipe, seed=3, videos_kind=kind)
    batches = []
    for epoch in epochs:
        dataset.set_epoch(epoch)
        batches += DataLoader(dataset, batch_size=3, drop_last=True)
    return batches
