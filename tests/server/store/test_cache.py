"""The cache: samples are those of the source, hit or miss, whatever happens to its folder."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clips import damaged, panned_luma, write_clip
from tests.oracles.leases import open_leases, whole_sample
from tests.server.prepare.test_lossless_served import require_equal
from v2v_protocol.errors import CorpusError, VideoChanged, VideoError
from v2v_protocol.messages import Lease, encode
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.folder import Folder
from v2v_server.store.cache import Cache, make_cache, piece_frames
from v2v_server.store.quota import PARTIAL, QuotaFolder, count_bytes, used_bytes
from v2v_server.system.process import locked
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import Clips

SPEC = StreamSpec(recipe=Recipe(voxels_per_clip=4, bins=5, crop_height_px=24, crop_width_px=32))
"""Needs 21 frames."""


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_server.store.cache.piece_frames", lambda rows, width_px: 16)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cached") / "source"
    write_clip(folder / "a.mp4", panned_luma(75, 90, 70), b_frames=2, gop=30)
    write_clip(folder / "b.webm", panned_luma(50, 96, 81), codec="libvpx-vp9")
    write_clip(folder / "turned.mov", panned_luma(41, 48, 96), rotation_degrees=90)
    write_clip(folder / "untimed.h264", panned_luma(40), rate=50, b_frames=2)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_cache(tmp_path / "cache")
    return tmp_path / "cache"


def leases_of(source: Path, count: int, spec: StreamSpec = SPEC) -> Iterator[tuple[Path, Lease]]:
    with open_leases(source, "top:0.9", spec) as (root, leases):
        for lease in islice(leases, count):
            yield root, lease


def made(lease: Lease, clips: Clips) -> tuple[Sample, str]:
    job = SampleJob.of(lease)
    decoded, _ = clips.take(job.clip, lease.indices)
    return make_sample(job, decoded), clips.said_of_cache(decoded)


def epoch(source: Path, cache: Cache, count: int = 8, spec: StreamSpec = SPEC) -> list[str]:
    """What was said of the cache; every sample is compared with that of the source."""
    said = []
    for root, lease in leases_of(source, count, spec):
        sample, of_cache = made(lease, Clips(Folder(root), cache))
        exact = whole_sample(replace(lease, indices=lease.indices[:1]), root)
        if of_cache == "hit":
            require_equal(sample, exact, "cache")
        else:
            assert sample.provenance == exact.provenance
            for name, array in exact.arrays.items():
                np.testing.assert_array_equal(sample.arrays[name], array)
        said.append(of_cache)
    return said


def pieces(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("??/*") if path.is_file())


@pytest.mark.parametrize("changes", [{}, {"voxels_per_clip": 2, "frame_stride": 2}, {"voxel_seconds": (0.04, 0.2)}])
def test_first_a_miss_then_hits(source: Path, folder: Path, changes: dict[str, Any]) -> None:
    spec = StreamSpec(recipe=SPEC.recipe.replace(**changes))
    first = epoch(source, Cache(folder, 1 << 30, 0), 8, spec)
    assert first[0] == "miss"
    assert set(first) <= {"hit", "miss"}
    assert epoch(source, Cache(folder, 1 << 30, 0), 8, spec) == ["hit"] * 8
    used = sum(path.stat().st_size for path in pieces(folder))
    assert used_bytes(folder) == used
    assert not list((folder / "partial").iterdir())
    (folder / "used").write_bytes(b"nonsense")
    assert used_bytes(folder) == 0
    make_cache(folder)  # as each start does
    assert used_bytes(folder) == used


def test_waits_for_other_processes_are_told_and_its_files_are_private(source: Path, folder: Path) -> None:
    """Each piece is decoded, then counted: the wait for the lock of the count is no decoding."""
    cache = Cache(folder, 1 << 30, 0)
    told: list[bool] = []
    cache.on_wait = told.append
    assert epoch(source, cache, 1) == ["miss"]
    assert told == [True, False] * len(pieces(folder))
    assert {stat.S_IMODE(path.stat().st_mode) for path in pieces(folder)} == {0o600}


def test_siblings_are_read_at_once(source: Path, folder: Path) -> None:
    spec = StreamSpec(recipe=SPEC.recipe, samples_per_decode=2, sibling_spacing=1)
    assert epoch(source, Cache(folder, 1 << 30, 0), 8, spec)[0] == "miss"
    assert set(epoch(source, Cache(folder, 1 << 30, 0), 8, spec)) == {"hit"}


def test_at_its_limit_it_keeps_what_it_has(source: Path, folder: Path) -> None:
    assert set(epoch(source, Cache(folder, 0, 0))) == {"miss: full: 0.00 of 0 GiB"}
    (said,) = set(epoch(source, Cache(folder, 1 << 30, least_free_bytes=1 << 60)))
    assert said.startswith("miss: disk full: ")
    assert not pieces(folder)
    epoch(source, Cache(folder, 1 << 30, 0), 2)
    kept = pieces(folder)
    said = epoch(source, Cache(folder, used_bytes(folder), 0))
    assert said[:2] == ["hit", "hit"]
    assert any("full" in each for each in said)
    assert pieces(folder) == kept


def test_a_folder_that_is_gone_is_not_made_again(source: Path, folder: Path) -> None:
    cache = Cache(folder, 1 << 30, 0)
    epoch(source, cache, 2)
    shutil.rmtree(folder)
    assert set(epoch(source, cache)) == {"miss: is gone: No such file or directory"}
    assert not folder.exists()
    assert set(epoch(source, Cache(folder, 1 << 30, 0))) == {"miss: is gone: No such file or directory"}


def test_a_write_that_fails(source: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("v2v_server.store.store_file.StoreWriter.close", full)
    assert set(epoch(source, Cache(folder, 1 << 30, 0))) == {"miss: cannot be written to: No space left on device"}
    assert not pieces(folder)
    assert not list((folder / "partial").iterdir())


@pytest.mark.parametrize("how", ["flipped", "cut", "empty", "another"])
def test_a_damaged_piece_is_decoded_again(source: Path, folder: Path, how: str) -> None:
    epoch(source, Cache(folder, 1 << 30, 0))
    for path in pieces(folder):
        content = bytearray(path.read_bytes())
        if how == "flipped":
            content[600:] = bytes(byte ^ 255 for byte in content[600:])
        elif how == "another":
            content = bytearray((source / "a.mp4").read_bytes())
        path.write_bytes({"cut": content[:600], "empty": b""}.get(how, content))
    said = epoch(source, Cache(folder, 1 << 30, 0))
    assert said[0].startswith("miss: a damaged piece was removed: ")
    assert set(epoch(source, Cache(folder, 1 << 30, 0))) == {"hit"}
    assert used_bytes(folder) >= sum(path.stat().st_size for path in pieces(folder))


def test_a_changed_source(source: Path, folder: Path, tmp_path: Path) -> None:
    """Nothing of what was kept of the old one is used for the new one; who was promised the old one is refused it."""
    shutil.copytree(source, tmp_path / "source")
    assert set(epoch(tmp_path / "source", Cache(folder, 1 << 30, 0), 40)) >= {"miss"}
    old = [lease for _, lease in leases_of(tmp_path / "source", 40)]
    new = write_clip(tmp_path / "new.mp4", panned_luma(75, 90, 70, step=(2, 1)))
    for path in (tmp_path / "source").iterdir():
        path.write_bytes(new.read_bytes())
    assert epoch(tmp_path / "source", Cache(folder, 1 << 30, 0))[0] == "miss"
    shutil.rmtree(folder)
    make_cache(folder)
    for lease in old:
        with pytest.raises(VideoChanged):
            made(lease, Clips(Folder(tmp_path / "source"), Cache(folder, 1 << 30, 0)))


def outcome_of(make: Callable[..., Sample], *arguments: object) -> bytes | str:
    """Return the voxels of a sample, or why its video is refused."""
    try:
        return make(*arguments).arrays["voxels"].tobytes()
    except VideoError as error:
        return str(error)


def test_damage_beyond_a_sample_does_not_spoil_it(tmp_path: Path, folder: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    write_clip(tmp_path / "whole.mp4", panned_luma(60, 90, 64), gop=60)
    damaged(tmp_path / "whole.mp4", source / "x.mp4", 25)
    kinds = set()
    for root, lease in leases_of(source, 4):
        exact = outcome_of(whole_sample, lease, root)
        assert outcome_of(lambda *each: made(*each)[0], lease, Clips(Folder(root), Cache(folder, 1 << 30, 0))) == exact
        kinds.add(type(exact))
    assert kinds == {str, bytes}


def test_what_a_killed_worker_leaves_is_not_used_and_removed(source: Path, folder: Path) -> None:
    """Killed in the middle of a piece: the file is there, under a name that is never read."""
    program = (
        "import os, signal, sys\nfrom pathlib import Path\nimport v2v_server.store.cache as cache\n"
        "from v2v_protocol.messages import decode\nfrom v2v_server.corpus.sources.folder import Folder\n"
        "from v2v_server.store.store_file import StoreWriter\nfrom v2v_server.worker.job import ClipJob\n"
        "from v2v_server.worker.making.read import Clips\n"
        "cache.piece_frames = lambda rows, width: 16\n"
        "StoreWriter.close = lambda self, **more: os.kill(os.getpid(), signal.SIGKILL)\n"
        "clips = Clips(Folder(Path(sys.argv[1])), cache.Cache(Path(sys.argv[2]), 1 << 30, 0))\n"
        "lease = decode(bytes.fromhex(sys.argv[3]))\n"
        "clips.take(ClipJob.of(lease), lease.indices)\n"
    )
    ((root, lease),) = leases_of(source, 1)
    done = subprocess.run([sys.executable, "-c", program, root, folder, bytes(encode(lease)[0]).hex()], check=False)
    assert done.returncode == -9
    assert len(list((folder / "partial").iterdir())) == 1
    assert not pieces(folder)
    with (folder / "partial" / "of one that lives").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        cache = Cache(folder, 1 << 30, 0)
        assert [path.name for path in (folder / "partial").iterdir()] == ["of one that lives"]
    epoch(source, cache)
    assert set(epoch(source, cache)) == {"hit"}


def test_pieces_of_large_pictures_are_short() -> None:
    assert [piece_frames(*size) for size in ((181, 596), (1080, 1920), (2160, 3840), (4320, 8192))] == [
        256,
        128,
        64,
        64,
    ]


def test_a_lock_that_is_never_released_costs_no_sample(source: Path, folder: Path) -> None:
    with locked(folder / "used.lock"):
        cache = Cache(folder, 1 << 30, 0)
        epoch(source, cache)
        assert "locked" in cache.trouble
        make_cache(folder)  # a server starts all the same
    assert set(epoch(source, Cache(folder, 1 << 30, 0))) <= {"miss", "hit"}


def test_the_used_file_is_private_and_a_pipe_in_its_place_blocks_nothing(folder: Path) -> None:
    (folder / "used").chmod(0o644)
    make_cache(folder)
    assert (folder / "used").stat().st_mode & 0o777 == 0o600
    (folder / "used").unlink()
    os.mkfifo(folder / "used")
    assert used_bytes(folder) == 0
    with pytest.raises(CorpusError, match="cannot be written to"):
        make_cache(folder)


# --- the folder that the cache and the copies of object storage fill --------------------------------------------------


@pytest.fixture
def quota(tmp_path: Path) -> QuotaFolder:
    made = QuotaFolder(tmp_path / "folder", 100, 0.0, 0)
    made.make()
    return made


def add(quota: QuotaFolder, name: str, size: int, *, evicts: bool = False) -> bool:
    """Add a file that is newer than all others."""
    partial = quota.folder / PARTIAL / name
    partial.write_bytes(bytes(size))
    path = quota.folder / "ab" / name
    added = quota.add(partial, path, evicts=evicts)
    if added:
        number = len(list(path.parent.iterdir()))
        os.utime(path, ns=(number, number))
    assert quota.used_bytes == count_bytes(quota.folder) <= 100
    return added


def names(quota: QuotaFolder) -> set[str]:
    return {path.name for path in (quota.folder / "ab").iterdir()}


def test_what_does_not_fit_is_not_added_and_what_is_replaced_counts_once(quota: QuotaFolder) -> None:
    assert add(quota, "a", 60)
    assert not add(quota, "b", 41)
    assert add(quota, "a", 40)
    assert quota.used_bytes == 40
    assert add(quota, "c", 60)
    assert names(quota) == {"a", "c"}
    quota.remove(quota.folder / "ab" / "a")
    assert quota.used_bytes == 60


def test_the_oldest_without_a_reader_goes(quota: QuotaFolder) -> None:
    for name in ("a", "b", "c"):
        assert add(quota, name, 30)
    with (quota.folder / "ab" / "a").open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        assert add(quota, "d", 30, evicts=True)
    assert names(quota) == {"a", "c", "d"}


def test_disk_space_that_others_need_is_freed(quota: QuotaFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        assert add(quota, name, 10)
    quota.least_free_bytes = 70
    monkeypatch.setattr(QuotaFolder, "free_bytes", property(lambda self: 85 - count_bytes(self.folder)))
    assert add(quota, "d", 10, evicts=True)
    assert names(quota) == {"c", "d"}


def test_a_lock_that_another_process_keeps_is_not_waited_for(quota: QuotaFolder) -> None:
    with quota.locked(), pytest.raises(BlockingIOError, match="another process keeps it locked; end that process"):
        quota.remove(quota.folder / "ab" / "a")
