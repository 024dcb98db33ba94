"""Files that other programs change in place while they are served: no wrong pixel is delivered, and none is kept."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import DEFAULT_ARRAYS
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.commands import prepare as prepare_command
from v2v_server.commands.prepare import main as run_prepare
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.source import open_source
from v2v_server.kinds.photographs import PhotographKind
from v2v_server.kinds.sequences import SequenceKind
from v2v_server.kinds.videos import VideoKind
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.store import cache as caches
from v2v_server.store import verified
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.photograph import kept_photographs
from v2v_server.store.picture_sequence import PictureSequence
from v2v_server.store.video_file import VideoFile
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import Clips
from v2v_tools.remake import lease_for

FRAMES, CHANGED = 126, 60
FORMS = {"video": VideoKind(), "pictures": SequenceKind(25.0)}
SPEC = StreamSpec(recipe=Recipe(voxels_per_clip=4, bins=5, crop_height_px=24, crop_width_px=32))
"""Needs 21 frames."""


class Corpus:
    """One video, of which other programs change a frame in place: size, head, tail and time of modification stay.

    Attributes:
        root: the folder.
        file: what is changed: the video, or the picture of one frame.
        kind: what a video is.
    """

    def __init__(self, folder: Path, form: str) -> None:
        self.root, self.kind = folder / "corpus", FORMS[form]
        luma = panned_luma(FRAMES, 90, 70)
        changed = luma.copy()
        changed[CHANGED] = 255 - luma[CHANGED]
        self.file = write_video(self.root, luma, form)
        other = write_video(folder / "other", changed, form)
        self._right, self._wrong = self.file.read_bytes(), other.read_bytes()
        assert self._right != self._wrong

    def change(self) -> None:
        """Give the frame other pixels."""
        self._write(self._wrong)

    def restore(self) -> None:
        """Give the frame its pixels again."""
        self._write(self._right)

    def _write(self, content: bytes) -> None:
        before = self.file.stat()
        with self.file.open("r+b") as file:
            file.write(content)
        os.utime(self.file, ns=(before.st_atime_ns, before.st_mtime_ns))
        after = self.file.stat()
        assert (after.st_size, after.st_mtime_ns, after.st_ino) == (before.st_size, before.st_mtime_ns, before.st_ino)

    def opened(self) -> closing[Catalogue]:
        """Open its catalogue."""
        return closing(open_catalogue(self.root, cache_dir=self.root.parent / "index", kind=self.kind, processes=0))


def write_video(root: Path, luma: npt.NDArray[np.uint8], form: str) -> Path:
    """Write a video without compression; return the file that holds the frame to change."""
    if form == "video":
        return write_clip(root / "a.avi", luma, codec="rawvideo")
    (root / "a").mkdir(parents=True)
    for number, picture in enumerate(luma):
        Image.fromarray(picture).save(root / "a" / f"{number:04}.bmp")
    return root / "a" / f"{CHANGED:04}.bmp"


def leases_of(catalogue: Catalogue, spec: StreamSpec = SPEC) -> list[Lease]:
    """Return the leases of one epoch."""
    schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, spec), spec)
    return [
        lease_for(
            Request(b"", 0, index), sequence=schedule.candidate(0, 0, index, 0), catalogue=catalogue, spec=spec, seed=0,
            arrays=DEFAULT_ARRAYS,
        )
        for index in range(schedule.count)
    ]  # fmt: skip


def made(leases: list[Lease], clips: Clips) -> list[bytes | None]:
    """Return the voxels and frames of each sample; None where the video is refused as changed."""
    found: list[bytes | None] = []
    for lease in leases:
        try:
            job = SampleJob.of(lease)
            sample = make_sample(job, clips.take(job.clip, lease.indices)[0])
            found.append(b"".join(array.tobytes() for array in sample.arrays.values()))
        except VideoChanged:
            found.append(None)
    return found


@pytest.fixture(params=FORMS)
def form(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def corpus(form: str, tmp_path: Path) -> Corpus:
    return Corpus(tmp_path, form)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    monkeypatch.setattr(caches, "piece_frames", lambda rows, width_px: 16)
    make_cache(tmp_path / "cache")
    return Cache(tmp_path / "cache", 1 << 30, 0)


@pytest.fixture
def read_whole(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collects the names of the files that are read whole."""
    found: list[str] = []
    for kind in (VideoFile, PictureSequence):

        def facts(self: Any, of: Callable[[Any], Any] = kind.facts) -> Any:
            found.append(Path(self._path).name)
            return of(self)

        monkeypatch.setattr(kind, "facts", facts)
    return found


@pytest.mark.parametrize("keeps", [False, True])
@pytest.mark.parametrize("seen", [False, True])
def test_what_is_changed_in_place_is_refused_until_it_is_restored(
    corpus: Corpus, cache: Cache, *, keeps: bool, seen: bool
) -> None:
    """Whether the worker has read the video before, and whether it keeps pieces of it."""
    with corpus.opened() as catalogue:
        leases = leases_of(catalogue)
        right = made(leases, Clips(Folder(corpus.root)))
        assert None not in right
        clips = Clips(Folder(corpus.root), cache if keeps else None)
        if seen:
            assert made(leases[:1], clips) == right[:1]
        corpus.change()
        changed = made(leases, clips)
        assert None in changed
        assert all(one in (None, each) for one, each in zip(changed, right, strict=True))
        corpus.restore()
        assert made(leases, clips) == right
        assert made(leases, clips) == right


@pytest.mark.parametrize("keeps", [False, True])
@pytest.mark.parametrize("fails", [False, True])
def test_what_changes_during_a_read_is_read_again(
    corpus: Corpus, cache: Cache, monkeypatch: pytest.MonkeyPatch, *, keeps: bool, fails: bool
) -> None:
    """It is restored when the read ends, which got wrong pixels or an error: the next read decides."""
    left = [0]

    def disturbed(read: Callable[..., Any]) -> Callable[..., Any]:
        def read_disturbed(self: Any, request: Any) -> Any:
            if not left[0]:
                return read(self, request)
            left[0] -= 1
            corpus.change()
            try:
                found = read(self, request)
                found = found if isinstance(found, tuple) else iter(list(found))  # read now
                if fails:
                    raise VideoError("a", CHANGED, "does not decode")
                return found
            finally:
                corpus.restore()

        return read_disturbed

    for name in ("clips", "pictures"):
        monkeypatch.setattr(VideoFile, name, disturbed(getattr(VideoFile, name)))
    with corpus.opened() as catalogue:
        leases = leases_of(catalogue)
        plain, clips = Clips(Folder(corpus.root)), Clips(Folder(corpus.root), cache if keeps else None)
        right = made(leases, plain)
        for lease, one in zip(leases, right, strict=True):
            left[0] = 1
            assert made([lease], clips) == [one]
        assert made(leases, clips) == right
        assert not left[0] or keeps  # the last ones were in the cache
        corpus.change()
        affected = leases[made(leases, plain).index(None)]
        corpus.restore()
        left[0] = 100
        with pytest.raises(VideoUnreadable, match="changes while it is read"):
            Clips(Folder(corpus.root)).take(ClipJob.of(affected), affected.indices)


def touched(path: Path) -> None:
    path.touch()


def replaced(path: Path) -> None:
    """Replace a file as rsync does: a copy under another name takes its place."""
    copy = path.with_name(f".{path.name}.x")
    shutil.copy2(path, copy)
    copy.replace(path)


def linked(path: Path) -> None:
    """Add a second name, which counts as a change of status."""
    path.with_name(f".{path.name}.link").hardlink_to(path)


def moved_aside(path: Path) -> None:
    """Leave a symbolic link to a copy elsewhere."""
    aside = path.parents[2] / f"aside-{path.name}"
    shutil.copy2(path, aside)
    path.unlink()
    path.symlink_to(aside)


@pytest.mark.parametrize("how", [lambda path: path.chmod(0o600), touched, replaced, linked, moved_aside])
def test_another_state_of_the_same_content_is_read_whole_once(
    corpus: Corpus, read_whole: list[str], how: Callable[[Path], None]
) -> None:
    with corpus.opened() as catalogue:
        leases = leases_of(catalogue)
        read_whole.clear()
        clips = Clips(Folder(corpus.root))
        right = made(leases, clips)
        assert read_whole == [], "it is in the state in which it was catalogued"
        how(corpus.file)
        assert None not in right
        assert made(leases, clips) == made(leases, clips) == right
        assert len(read_whole) == 1


def test_a_copy_on_another_host_is_read_whole_once(corpus: Corpus, read_whole: list[str]) -> None:
    with corpus.opened() as catalogue:
        leases = leases_of(catalogue)
        right = made(leases, Clips(Folder(corpus.root)))
        other = corpus.root.parent / "node"
        shutil.copytree(corpus.root, other)
        read_whole.clear()
        source = Folder(other)
        files = {leases[0].video: leases[0].fingerprint}
        source.expected = leases[0].video, leases[0].notes.state
        assert not source.has(files), "this happens before a lease begins, so that no deadline runs"
        source.fetch(files)
        assert source.has(files)
        clips = Clips(source)
        assert made(leases, clips) == made(leases, clips) == right
        assert len(read_whole) == 1


def test_a_large_file_is_not_read_whole_within_a_lease(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verified, "_SOON_BYTES", 1000)
    with corpus.opened() as catalogue:
        leases = leases_of(catalogue)
        source = Folder(corpus.root)
        right = made(leases, Clips(source))
        corpus.file.chmod(0o600)
        with pytest.raises(VideoUnreadable, match="read whole first"):
            made(leases, Clips(source))
        source.fetch({leases[0].video: leases[0].fingerprint})
        assert made(leases, Clips(source)) == right


def test_the_server_believes_a_worker_only_if_its_own_file_has_another_state(corpus: Corpus) -> None:
    with corpus.opened() as catalogue:
        (video,) = catalogue.videos
        catalogue.check_state(video.id)
        corpus.change()
        catalogue.check(video.id, video.fingerprint)  # size, head and tail are the same
        with pytest.raises(VideoChanged, match="changed since it was catalogued"):
            catalogue.check_state(video.id)


def prepared(corpus: Corpus, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run v2v-prepare; return its status and what it prints."""
    flags = ["--videos-kind", "sequences", "--rate", "25"] if corpus.kind.has_parts else []
    status = run_prepare([
        str(corpus.root), str(corpus.root.parent / "store"), "--workers", "1", "--cache-dir",
        str(corpus.root.parent / "index"), *flags,
    ])  # fmt: skip
    return status, capsys.readouterr().out


def test_prepare_stores_nothing_of_a_changed_file(
    corpus: Corpus, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The change comes between the catalogue and the transcoding."""
    with corpus.opened() as catalogue:
        right = made(leases_of(catalogue), Clips(Folder(corpus.root)))
    with monkeypatch.context() as patch:

        def late(*arguments: Any, **more: Any) -> Any:
            corpus.change()
            return transcode_all(*arguments, **more)

        transcode_all = prepare_command.prepare
        patch.setattr(prepare_command, "prepare", late)
        status, said = prepared(corpus, capsys)
    assert status == 1
    assert "changed since it was catalogued" in said
    assert "equals" not in said
    corpus.restore()
    status, said = prepared(corpus, capsys)
    assert status == 0, said
    assert "every frame was read back and equals the source's, bit for bit" in said
    assert "read whole first, and have the hash of the catalogue: 1" in said
    store = corpus.root.parent / "store"
    with closing(open_catalogue(store, cache_dir=store.parent / "index", processes=0)) as catalogue:
        assert made(leases_of(catalogue), Clips(open_source(store))) == right


@pytest.mark.parametrize("seen", [False, True])
def test_photographs_are_compared_when_they_are_decoded(tmp_path: Path, *, seen: bool) -> None:
    """Their head and tail are of 64 KiB each; the rest is compared in memory, so no state is needed."""
    root = tmp_path / "photographs"
    root.mkdir()
    grey = np.random.default_rng(1).integers(0, 256, (400, 400), np.uint8)
    contents = []
    for inverted in (0, 1):
        grey[200] ^= 255 * np.uint8(inverted)
        Image.fromarray(grey).save(root / "a.bmp")
        contents.append((root / "a.bmp").read_bytes())
    file = root / "a.bmp"
    file.write_bytes(contents[0])
    kind = PhotographKind()
    worlds = StreamSpec(recipe=preset("worlds").replace(crop_height_px=32, crop_width_px=40))
    with closing(open_catalogue(root, cache_dir=tmp_path / "index", kind=kind, processes=0)) as catalogue:
        leases = leases_of(catalogue, worlds)[:3]
        right = made(leases, Clips(Folder(root)))
        assert len(right) == 3
        if not seen:
            kept_photographs.clear()
        before = file.stat()
        for content in (contents[1], contents[0]):
            with file.open("r+b") as opened:
                opened.write(content)
            os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
            found = made(leases, Clips(Folder(root)))
            assert found == (right if content is contents[0] else [None] * 3)
