"""A catalogue of videos in object storage; the store is a folder, asked through fsspec."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import CorpusError, VideoChanged, VideoGone
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.copies import Bucket

pytest.importorskip("fsspec", reason="the extra 'cloud' is not installed")


@pytest.fixture(scope="module")
def _written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_clip(folder / "a.mp4", panned_luma(20))
    write_clip(folder / "b.mkv", panned_luma(24, step=(2, 1)))
    return folder


@pytest.fixture
def store(_written: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "store"
    (folder / "deep").mkdir(parents=True)
    for source, name in (("a.mp4", "a.mp4"), ("b.mkv", "deep/b.mkv"), ("a.mp4", ".hidden/a.mp4"), ("a.mp4", "a.txt")):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes((_written / source).read_bytes())
    return folder


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was fetched so far."""
    ids: list[str] = []
    fetch = Bucket.fetch

    def noted(self: Bucket, id: str, to: Path) -> None:
        ids.append(id)
        fetch(self, id, to)

    monkeypatch.setattr(Bucket, "fetch", noted)
    return ids


@contextmanager
def catalogue(store: Path, *, is_folder: bool = False, list_file: Path | None = None) -> Iterator[Catalogue]:
    source = str(store) if is_folder else f"file://{store}"
    opened = open_catalogue(source, cache_dir=store.parent / "cache", list_file=list_file, processes=0)
    try:
        yield opened
    finally:
        opened.close()


def test_it_is_the_catalogue_of_the_folder(store: Path, fetched: list[str]) -> None:
    with catalogue(store, is_folder=True) as local, catalogue(store) as remote:
        assert remote.digest == local.digest
        assert list(remote.videos) == list(local.videos)
        assert not remote.source.is_local
        with pytest.raises(CorpusError, match="not a folder of this host"):
            remote.path("a.mp4")
    assert sorted(fetched) == ["a.mp4", "deep/b.mkv"]


def test_what_is_new_or_changed_is_fetched(store: Path, fetched: list[str]) -> None:
    with catalogue(store) as first:
        fetched.clear()
        with catalogue(store) as again:
            assert (again.digest, fetched) == (first.digest, [])
        (store / "a.mp4").write_bytes((store / "deep" / "b.mkv").read_bytes())
        os.rename(store / "deep" / "b.mkv", store / "c.mkv")
        with pytest.raises(VideoChanged):
            first.check("a.mp4", first.videos[0].fingerprint)
        with pytest.raises(VideoGone):
            first.check("deep/b.mkv", first.videos[1].fingerprint)
    with catalogue(store) as later:
        assert [video.id for video in later.videos] == ["a.mp4", "c.mkv"]
        assert sorted(fetched) == ["a.mp4", "c.mkv"]
        later.check("a.mp4", later.videos[0].fingerprint)
        later.mark_stale("a.mp4")
        with pytest.raises(VideoChanged):  # that it is in doubt must not hide that it was found wanting
            later.check("a.mp4", later.videos[0].fingerprint)


def test_a_list_restricts_it(store: Path, tmp_path: Path, fetched: list[str]) -> None:
    names = tmp_path / "names.txt"
    names.write_text("deep/b.mkv\nnone.mp4\n", encoding="utf-8")
    with catalogue(store, list_file=names) as remote:
        assert [video.id for video in remote.videos] == ["deep/b.mkv"]
        assert [(each.video, each.reason) for each in remote.refusals] == [
            ("none.mp4", f"is not in file://{store} any more")
        ]
    assert fetched == ["deep/b.mkv"]


def test_a_prepared_corpus_has_to_be_on_a_disk(store: Path) -> None:
    (store / "deep" / "v2v-prepared.jsonl").write_text("{}\n", encoding="utf-8")
    with pytest.raises(CorpusError, match="makes it a prepared corpus"), catalogue(store):
        pass


def test_an_empty_address(store: Path) -> None:
    with pytest.raises(CorpusError, match="no video found"), catalogue(store / "nothing"):
        pass
