"""Archives in object storage: the same ids, catalogue and samples as those of a folder, few questions, and no mixture
of two states of one archive.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from tests.digests.rows import Row, samples_of
from tests.packed import pack, packed_forms
from tests.server.corpus.sources.test_http import Web, web
from tests.server.corpus.test_archives import CLIP, tar_of, zip_of
from v2v_protocol.errors import VideoChanged, VideoGone
from v2v_server.corpus import members
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources import archives
from v2v_server.corpus.sources.archives import CUT, LEAVES
from v2v_server.corpus.sources.copies import Bucket
from v2v_server.corpus.sources.source import MemberPlace, archive_mark
from v2v_server.prepare import prepare

__all__ = ["web"]
pytest.importorskip("aiohttp", reason="the extra 'cloud' is not installed")
ROW = Row({"bins": 1, "voxels_per_clip": 2}, count=6)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plain") / "corpus"
    for number, name in enumerate(("0/a.mp4", "0/deep/b.mkv", "1/c.mp4", "1/d.h264")):
        write_clip(folder / name, panned_luma(24, 32, 40, step=(1, 1 + number)))
        (folder / name).with_suffix(".txt").write_text("a caption")
    return folder


@pytest.fixture(scope="module")
def forms(plain: Path) -> Mapping[str, Path]:
    return packed_forms(plain, plain.parent)


def opened(address: str | Path, tmp_path: Path, **options: Any) -> closing[Catalogue]:
    options = {"cache_dir": tmp_path, "copies": tmp_path / "copies", "processes": 0, **options}
    return closing(open_catalogue(address, **options))


def snapshot(catalogue: Catalogue) -> tuple[Any, ...]:
    samples = [(each.provenance, each.arrays["voxels"].tobytes()) for each in samples_of(catalogue, ROW)]
    return list(catalogue.videos), catalogue.refusals, catalogue.digest, samples


def serve(web: Web, folder: Path) -> str:
    """Put the files of a folder, without folders in it, on a server that sends parts; return their address."""
    web.ranges = True
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    web.files = {"/v/": "".join(f'<a href="{name}">x</a>' for name in files)}
    web.files |= {f"/v/{name}": data for name, data in files.items()}
    web.asked.clear()
    return f"{web.url}/v"


@pytest.mark.parametrize("form", ["tar", "zip"])
@pytest.mark.parametrize("store", ["http", "file"])
def test_an_archive_in_a_store_is_the_folder_that_it_unpacks_to(
    plain: Path,
    forms: Mapping[str, Path],
    web: Web,
    tmp_path: Path,
    form: str,
    store: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Only a confined process parses an archive, and a second start reads none."""
    monkeypatch.setattr(archives, "read_table", pytest.fail)
    address = serve(web, forms[form]) if store == "http" else f"file://{forms[form]}"
    with opened(plain, tmp_path / "plain") as catalogue:
        reference = snapshot(catalogue)
    with opened(address, tmp_path, processes=1) as catalogue:
        assert snapshot(catalogue) == reference
        for video in catalogue.videos:
            catalogue.check(video.id, video.fingerprint)
    monkeypatch.setattr(members, "read_table", pytest.fail)
    probed = list[int]()
    with opened(address, tmp_path, progress=lambda done, total: probed.append(done)) as catalogue:
        assert (catalogue.digest, probed) == (reference[2], [])


@pytest.mark.parametrize(("form", "to_index"), [("tar", 1), ("zip", 1)])
def test_a_member_is_one_question(
    forms: Mapping[str, Path], web: Web, tmp_path: Path, form: str, to_index: int
) -> None:
    address = serve(web, forms[form])
    with opened(address, tmp_path) as catalogue:
        videos, count = len(catalogue.videos), len(samples_of(catalogue, ROW))
    assert count == ROW.count
    asked = Counter(web.asked)
    # A listing over HTTP states no sizes: each archive is asked for its state.
    assert asked["HEAD /v/0." + form] == asked["HEAD /v/1." + form] == 1
    assert asked["GET /v/0." + form] + asked["GET /v/1." + form] == 2 * to_index + videos


def test_of_a_large_zip_only_its_directory_is_read(web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that the first answer does not hold whole."""
    monkeypatch.setattr("v2v_server.corpus.sources.copies.ZIP_END_BYTES", 200)
    sizes = list[int]()
    copy = "v2v_server.corpus.sources.copies.copy_bytes"
    monkeypatch.setattr(copy, _counted(sizes))
    clip = write_clip(tmp_path / "a.mp4", panned_luma(24, 32, 40)).read_bytes()
    names = [(f"{number:03}.txt", CLIP) for number in range(200)]
    zip_of(tmp_path / "corpus.zip", ("a.mp4", clip), *names)
    (tmp_path / "corpus").mkdir()
    (tmp_path / "corpus.zip").rename(tmp_path / "corpus" / "x.zip")
    with opened(serve(web, tmp_path / "corpus"), tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["x/a.mp4"]
        assert samples_of(catalogue, ROW)
    assert Counter(web.asked)["GET /v/x.zip"] == 3
    assert sum(sizes) < 40_000 + len(clip) < (tmp_path / "corpus" / "x.zip").stat().st_size / 4


def _counted(sizes: list[int]) -> Callable[..., None]:
    from v2v_server.corpus.sources.object_parts import copy_bytes

    def counted(read: Any, file: Any, size: int) -> None:
        sizes.append(size)
        copy_bytes(read, file, size)

    return counted


@pytest.mark.parametrize("store", ["http", "file"])
def test_an_archive_that_changed_is_refused_and_not_mixed(
    plain: Path, web: Web, tmp_path: Path, store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its members lie where they lay."""
    corpus, below = tmp_path / "corpus", tmp_path / "below"
    below.mkdir()
    clip = (plain / "0" / "a.mp4").read_bytes()
    for name in "ab":
        (below / f"{name}.mp4").write_bytes(clip)
    pack(below, corpus / "0.tar")
    address = serve(web, corpus) if store == "http" else f"file://{corpus}"
    with opened(address, tmp_path) as catalogue:
        source, (first, second) = catalogue.source, catalogue.videos
        states = {video.id: catalogue.state(video.id) for video in (first, second)}
        os.utime(below / "b.mp4", (1e9, 1e9))
        pack(below, corpus / "0.tar")
        if store == "http":
            serve(web, corpus)
        for path in (tmp_path / "copies").glob("??/*"):
            path.unlink()
        for video in (first, second):
            with pytest.raises(VideoChanged, match=rf"{video.id}.*changed in .* since it was catalogued"):
                catalogue.check(video.id, video.fingerprint)
            source.expected = video.id, states[video.id] or ()
            with pytest.raises(VideoChanged, match=r"since it was catalogued: 0\.tar differs"):
                source.fetch({video.id: video.fingerprint})
        assert not source.has({first.id: first.fingerprint})
    with opened(address, tmp_path) as catalogue:
        assert list(catalogue.videos) == [first, second]
    if store == "http":
        web.files.pop("/v/0.tar")
        with pytest.raises(VideoGone):
            source.verify(first.id, first.fingerprint, states[first.id])


def test_an_archive_that_changes_while_it_is_read_is_read_again_at_the_next_start(
    forms: Mapping[str, Path], web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, listed, objects = serve(web, forms["tar"]), web.files.copy(), Bucket.objects

    def then_changed(bucket: Bucket) -> dict[str, Any]:
        found = objects(bucket)
        web.files["/v/0.tar"] = web.files["/v/1.tar"]
        return found

    with monkeypatch.context() as patched:
        patched.setattr(Bucket, "objects", then_changed)
        with opened(address, tmp_path) as catalogue:
            assert {each.video: each.reason for each in catalogue.refusals} == {
                "0.tar": f"changed in {address} since it was catalogued: 0.tar differs"
            }
            assert {id[0] for id in catalogue.videos.ids} == {"1"}
    web.files = listed
    with opened(address, tmp_path) as catalogue:
        assert (len(catalogue.videos), catalogue.refusals) == (4, ())


def test_a_server_without_parts_is_refused_in_words(forms: Mapping[str, Path], web: Web, tmp_path: Path) -> None:
    address = serve(web, forms["tar"])
    write_clip(tmp_path / "z.mp4", panned_luma(24, 32, 40))
    web.files["/v/"] = f'{web.files["/v/"]!s}<a href="z.mp4">z</a>'
    web.files["/v/z.mp4"] = (tmp_path / "z.mp4").read_bytes()
    web.ranges = False
    with opened(address, tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["z.mp4"]
        assert {each.reason for each in catalogue.refusals} == {
            "its server sends whole files only: copy the archives to a disk"
        }


HOSTILE = {
    "cut": ("x.tar", lambda path: tar_of(path, ("a.mp4", CLIP))[:2048], {"x.tar": CUT}),
    "no tar": ("x.tar", lambda path: CLIP * 9000, {"x.tar": CUT}),
    "no zip": ("x.zip", lambda path: CLIP, {"x.zip": CUT}),
    "joined": ("x.tar", lambda path: 2 * tar_of(path, ("a.mp4", CLIP)), {"x.tar": "has bytes behind its end mark"}),
    "empty": ("x.tar", lambda path: b"", {"x.tar": "is empty, or its store does not say how large it is"}),
    "a zip header": (
        "x.zip",
        lambda path: b"x" * 20 + zip_of(path, ("a.mp4", CLIP))[20:],
        {"x/a.mp4": "its header in x.zip is damaged"},
    ),
    "names": ("x.tar", lambda path: tar_of(path, ("../a.mp4", CLIP)), {"x/../a.mp4": LEAVES}),
    "beside a folder": (
        "y.tar",
        lambda path: tar_of(path, ("a.mp4", CLIP)),
        {"y.tar": "would give the same ids as y beside it"},
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("processes", [0, 1])
def test_what_cannot_be_read_is_refused_in_words(case: str, processes: int, tmp_path: Path) -> None:
    """Alone: the video beside it is served."""
    name, make, expected = HOSTILE[case]
    corpus = tmp_path / "corpus"
    write_clip(corpus / "y" / "good.mp4", panned_luma(24, 32, 40))
    (corpus / name).write_bytes(make(tmp_path / name))
    with opened(f"file://{corpus}", tmp_path, processes=processes) as catalogue:
        assert list(catalogue.videos.ids) == ["y/good.mp4"]
        refused = {each.video: each.reason for each in catalogue.refusals}
    assert refused.keys() == expected.keys()
    for id, reason in expected.items():
        assert reason in refused[id]


def test_one_archive_and_lists(plain: Path, forms: Mapping[str, Path], web: Web, tmp_path: Path) -> None:
    address, listed = serve(web, forms["tar"]), tmp_path / "list.txt"
    with opened(f"{address}/1.tar", tmp_path / "one") as catalogue:
        assert list(catalogue.videos.ids) == ["1/c.mp4", "1/d.h264"]
    for text, expected, refused in (
        ("1.tar\n0/a.mp4\n", ["0/a.mp4", "1/c.mp4", "1/d.h264"], []),
        ("0/deep/b.mkv\n0/none.mp4\n", ["0/deep/b.mkv"], ["0/none.mp4"]),
    ):
        listed.write_text(text)
        with opened(address, tmp_path, list_file=listed) as catalogue:
            assert list(catalogue.videos.ids) == expected
            assert [each.video for each in catalogue.refusals] == refused


def test_labels_in_archives_of_a_store_are_refused_in_words(plain: Path, tmp_path: Path) -> None:
    below = tmp_path / "below"
    below.mkdir()
    for name in "ab":
        (below / f"{name}.mp4").write_bytes((plain / "0" / "a.mp4").read_bytes())
        (below / f"{name}.boxes.json").write_text("[]")
    pack(below, tmp_path / "corpus" / "0.tar")
    with opened(f"file://{tmp_path / 'corpus'}", tmp_path) as catalogue:
        assert catalogue.notes == (
            "2 sidecars cannot be read and count as missing (0/a.boxes.json: lies in an archive of object storage, "
            "where none is read: unpack it)",
        )


def test_deflated_members_are_inflated_while_they_are_copied(plain: Path, tmp_path: Path, web: Web) -> None:
    """They have the catalogue, samples and prepared files of the folder."""
    corpus, clip = tmp_path / "corpus", (plain / "0" / "a.mp4").read_bytes()
    corpus.mkdir()
    padded = clip + bytes(3 << 20)  # more than the zip file has
    zip_of(corpus / "0.zip", ("a.mp4", clip), ("b.mp4", padded), method=ZIP_DEFLATED)
    for name, data in (("a.mp4", clip), ("b.mp4", padded)):
        (tmp_path / "unpacked" / "0").mkdir(parents=True, exist_ok=True)
        (tmp_path / "unpacked" / "0" / name).write_bytes(data)
    with opened(tmp_path / "unpacked", tmp_path / "plain") as catalogue:
        reference = snapshot(catalogue)
        prepare(catalogue, tmp_path / "store" / "plain", processes=0)
    for address in (serve(web, corpus), f"file://{corpus}"):
        with opened(address, tmp_path) as catalogue:
            assert snapshot(catalogue) == reference
            prepare(catalogue, tmp_path / "store" / "zip", processes=0)
    for name in ("0/a.mp4", "0/b.mp4"):
        files = [tmp_path / "store" / form / name for form in ("plain", "zip")]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_a_member_larger_than_all_copies_is_not_begun(tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    write_clip(corpus / "y" / "good.mp4", panned_luma(24, 32, 40))
    zip_of(corpus / "x.zip", ("a.mp4", bytes(4 << 20)), method=ZIP_DEFLATED)
    with opened(f"file://{corpus}", tmp_path, copies_gib=1 / 512) as catalogue:
        assert [(each.video, each.reason) for each in catalogue.refusals] == [
            ("x/a.mp4", "its 4194304 bytes exceed the limit of copies: raise --copies-gib")
        ]


@given(
    st.integers(0, 2**40),
    st.integers(0, 2**48 - 1),
    st.tuples(*[st.integers(0, 2**63 - 1)] * 3),
    st.sampled_from([".tar", ".zip"]),
    st.text("ab/.", min_size=1, max_size=1024),
)
def test_the_state_of_a_member_says_where_it_lies(
    size: int, start: int, state: tuple[int, int, int], ending: str, stem: str
) -> None:
    """In numbers that a message and the index can hold."""
    archive = stem + ending
    member = MemberPlace(archive, size, start, archive_mark(archive, state))
    assert MemberPlace.of(f"{stem}/a.mp4", member.state) == member
    assert all(0 <= number < 2**63 for number in member.state)
    assert member.is_in(state)
    assert MemberPlace.of(f"{stem}/a.mp4", (size, 1_700_000_000_000_000_000, 1_700_000_000_000_000_000)) is None


@pytest.mark.parametrize(
    ("change", "expected"),
    [(-1, "it has more than the"), (1, "it has fewer than the"), (0, "cannot be inflated")],
)
def test_a_member_that_inflates_to_another_size_is_refused(change: int, expected: str, tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    write_clip(corpus / "y" / "good.mp4", panned_luma(24, 32, 40))
    data = zip_of(corpus / "x.zip", ("a.mp4", CLIP), method=ZIP_DEFLATED)
    size = len(CLIP).to_bytes(4, "little")
    changed = data.replace(size, (len(CLIP) + change).to_bytes(4, "little"))
    at = data.index(b"a.mp4") + 5
    (corpus / "x.zip").write_bytes(changed if change else data[:at] + b"\xff" * 9 + data[at + 9 :])
    with opened(f"file://{corpus}", tmp_path) as catalogue:
        (refusal,) = catalogue.refusals
    assert (refusal.video, expected in refusal.reason) == ("x/a.mp4", True), refusal
