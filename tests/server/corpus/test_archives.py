"""Videos in archives: the same ids, catalogue and samples as those of the folder that an archive unpacks to."""

from __future__ import annotations

import io
import os
import re
import shutil
import tarfile
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.clips import panned_luma, truncated, write_clip
from tests.digests.rows import Row, samples_of
from tests.packed import pack, packed_forms
from v2v_protocol.command import FAILED
from v2v_protocol.errors import CorpusError, VideoChanged, VideoGone, VideoUnreadable
from v2v_server.commands.prepare import main
from v2v_server.corpus import members
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources import archives
from v2v_server.corpus.sources.sidecars import open_sidecar, read_files
from v2v_server.corpus.sources.source import MANIFEST_NAME, SourceOptions, open_source
from v2v_server.prepare import prepare
from v2v_server.video.file_range import FileRange, open_bytes

ROW = Row({"bins": 1, "voxels_per_clip": 2}, count=12)
MJPEG = {"codec": "mjpeg", "pixel_format": "yuvj420p"}
FORMS: Mapping[str, Mapping[str, Any]] = {
    "a.mp4": {"b_frames": 2}, "b.mov": {"pixel_format": "yuv444p"}, "c.mkv": {}, "d.webm": {"codec": "libvpx-vp9"},
    "e.avi": {"codec": "mpeg4"}, "f.ts": {}, "g.flv": {}, "h.mpg": {"codec": "mpeg2video"}, "i.h264": {},
    "j.mjpeg": MJPEG, "k.y4m": {"codec": "wrapped_avframe"}, "l.ivf": {"codec": "libvpx"}, "m.3gp": {},
    "n.mp4": {"options": {"movflags": "frag_keyframe+empty_moov"}},
}  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of folders with a clip of each container, one that is cut short, and files that are no videos."""
    folder = tmp_path_factory.mktemp("plain") / "corpus"
    for number, (name, options) in enumerate(FORMS.items()):
        below = folder / ("00000", "00001")[number % 2] / ("deep" * (number % 3 == 0))
        write_clip(below / name, panned_luma(24, 32, 40, step=(1, 1 + number % 3)), **options)
        (below / f"{name[0]}.txt").write_text("a caption")
    truncated(folder / "00000" / "deep" / "a.mp4", folder / "00000" / "cut.mp4", 0.6)
    truncated(folder / "00000" / "c.mkv", folder / "00000" / "cut.mkv", 0.6)
    return folder


def opened(folder: Path, cache: Path, **options: Any) -> closing[Catalogue]:
    return closing(open_catalogue(folder, cache_dir=cache, **{"processes": 0, **options}))


def snapshot(catalogue: Catalogue) -> tuple[Any, ...]:
    """All that a consumer can tell: ids, what is known of each video, refusals, digest and samples."""
    videos = list(catalogue.videos)
    refusals = [(each.video, each.frame, each.reason) for each in catalogue.refusals]
    arrays = [
        (each.provenance, *(each.arrays[name].tobytes() for name in ROW.arrays)) for each in samples_of(catalogue, ROW)
    ]
    return list(catalogue.videos.ids), videos, refusals, catalogue.digest, arrays


@pytest.fixture(scope="module")
def forms(plain: Path) -> Mapping[str, Path]:
    return packed_forms(plain, plain.parent)


@pytest.fixture(scope="module")
def reference(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ...]:
    with opened(plain, tmp_path_factory.mktemp("index")) as catalogue:
        return snapshot(catalogue)


@pytest.mark.parametrize("form", ["tar", "zip"])
def test_an_archive_is_the_folder_that_it_unpacks_to(
    forms: Mapping[str, Path],
    reference: tuple[Any, ...],
    tmp_path: Path,
    form: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Only a confined process parses an archive."""
    monkeypatch.setattr("v2v_server.corpus.sources.folder.read_table", pytest.fail)
    with opened(forms[form], tmp_path, processes=1) as catalogue:
        assert snapshot(catalogue) == reference
        assert (len(reference[0]), len(reference[2])) == (len(FORMS) + 1, 1)
        for video in catalogue.videos:
            catalogue.check(video.id, video.fingerprint)


def test_a_second_start_reads_no_archive(
    forms: Mapping[str, Path], reference: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened(forms["tar"], tmp_path).__enter__().close()
    monkeypatch.setattr(members, "read_table", pytest.fail)
    probed = list[int]()
    with opened(forms["tar"], tmp_path, progress=lambda done, total: probed.append(done)) as catalogue:
        assert (catalogue.digest, probed) == (reference[3], [])


def test_samples_and_checks_need_no_table(
    forms: Mapping[str, Path], reference: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(forms["zip"], tmp_path) as catalogue:
        monkeypatch.setattr("v2v_server.corpus.sources.folder.read_table", None)
        assert snapshot(catalogue) == reference
        video = catalogue.videos[0]
        catalogue.check(video.id, video.fingerprint)
        catalogue.check_state(video.id)


def test_an_archive_that_changed_is_probed_again(plain: Path, tmp_path: Path) -> None:
    corpus, below = tmp_path / "corpus", tmp_path / "below"
    shutil.copytree(plain / "00001", below)
    pack(below, corpus / "0.tar")
    with opened(corpus, tmp_path) as catalogue:
        first, ids = catalogue.videos[0], list(catalogue.videos.ids)
        write_clip(below / "another.mp4", panned_luma(30, 32, 40))
        shutil.copy(below / "another.mp4", below / first.id.removeprefix("0/"))
        pack(below, corpus / "0.tar")
        with pytest.raises(VideoChanged):
            catalogue.check(first.id, first.fingerprint)
        with pytest.raises(VideoChanged):
            catalogue.check_state(first.id)
    probed = list[int]()
    with opened(corpus, tmp_path, progress=lambda done, total: probed.append(done)) as catalogue:
        assert list(catalogue.videos.ids) == sorted([*ids, "0/another.mp4"])
        assert len(probed) == len(ids) + 1
        number = catalogue.videos.find(first.id)
        assert number is not None
        assert catalogue.videos[number].frames == 30
    (corpus / "0.tar").unlink()
    write_clip(corpus / "a.mp4", panned_luma(24, 32, 40))
    with opened(corpus, tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["a.mp4"]


def test_an_archive_of_other_times_is_read_whole_and_another_place_is_no_video(
    plain: Path, reference: tuple[Any, ...], tmp_path: Path
) -> None:
    """As on a host with a copy of the corpus."""
    corpus = tmp_path / "corpus"
    for below in sorted(plain.iterdir()):
        pack(below, corpus / f"{below.name}.tar")
    with opened(corpus, tmp_path) as catalogue:
        for archive in corpus.iterdir():
            os.utime(archive, (1e9, 1e9))
        assert snapshot(catalogue) == reference
        for below in sorted(plain.iterdir()):
            shutil.copytree(below, tmp_path / below.name)
            (tmp_path / below.name / "0.txt").write_text("moves all that follows" * 100)
            pack(tmp_path / below.name, corpus / f"{below.name}.tar")
        with pytest.raises(VideoChanged):
            samples_of(catalogue, ROW)


def test_an_archive_alone_and_lists_of_archives_and_members(
    plain: Path, forms: Mapping[str, Path], tmp_path: Path
) -> None:
    with opened(plain, tmp_path / "plain") as catalogue:
        ids = list(catalogue.videos.ids)
    of_second = [id for id in ids if id.startswith("00001/")]
    with opened(forms["tar"] / "00001.tar", tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == of_second
    listed = tmp_path / "list.txt"
    for text, expected, refused in (
        ("00001.tar\n00000/cut.mkv\n", ["00000/cut.mkv", *of_second], []),
        (f"{of_second[1]}\n{of_second[0]}\n00000/none.mp4\n", of_second[:2], ["00000/none.mp4"]),
    ):
        listed.write_text(text)
        with opened(forms["tar"], tmp_path, list_file=listed) as catalogue:
            assert list(catalogue.videos.ids) == expected
            assert [each.video for each in catalogue.refusals] == refused


def test_archives_of_equal_ids_are_refused_and_a_folder_goes_before(
    plain: Path, forms: Mapping[str, Path], tmp_path: Path
) -> None:
    corpus = tmp_path / "corpus"
    shutil.copytree(plain / "00000" / "deep", corpus / "00000")
    for form in ("tar", "zip"):
        shutil.copy(forms[form] / f"00000.{form}", corpus)
        shutil.copy(forms[form] / f"00001.{form}", corpus)
    with opened(corpus, tmp_path) as catalogue:
        assert {id.split("/")[0] for id in catalogue.videos.ids} == {"00000"}
        assert {each.video: each.reason for each in catalogue.refusals} == {
            f"{stem}.{form}": f"would give the same ids as {other} beside it: move one of them away"
            for stem, form, other in (
                ("00000", "tar", "00000"), ("00000", "zip", "00000"), ("00001", "tar", "00001.zip"),
                ("00001", "zip", "00001.tar"),
            )
        }  # fmt: skip


def test_archives_without_videos_are_passed_over(plain: Path, tmp_path: Path) -> None:
    pack(Path(__file__).parent / "scenes", tmp_path / "corpus" / "code.zip")
    with pytest.raises(CorpusError, match=r"no video found; looked for .* also in \.tar and \.zip archives"):
        open_catalogue(tmp_path / "corpus", cache_dir=tmp_path, processes=0)
    write_clip(tmp_path / "corpus" / "a.mp4", panned_luma(24, 32, 40))
    with opened(tmp_path / "corpus", tmp_path) as catalogue:
        assert (list(catalogue.videos.ids), catalogue.refusals) == (["a.mp4"], ())


def test_a_range_is_read_as_a_file_and_opened_as_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a, :b'.tar"
    path.write_bytes(bytes(range(200)))
    part = FileRange(str(path), 50, 60)
    assert (FileRange.parse(part), FileRange.parse(path)) == (part, None)
    with open_bytes(part) as file:
        assert (file.read(4), file.seek(-2, 2), file.read(), file.seek(2), file.read(3)) == (
            bytes(range(50, 54)), 8, bytes((58, 59)), 2, bytes(range(52, 55)),
        )  # fmt: skip
    with pytest.raises(FileNotFoundError):
        os.open(part, os.O_RDONLY)
    with pytest.raises(VideoUnreadable, match="its archive ends before it does"):
        open_bytes(FileRange(str(path), 150, 201))
    with pytest.raises(VideoUnreadable, match="is not a regular file"):
        open_bytes(tmp_path)


def test_sidecars_are_found_in_archives_as_beside_files(tmp_path: Path) -> None:
    """Beside a caption, which is passed over."""
    folder = tmp_path / "plain"
    for name in ("a.mp4", "deep/b.mp4"):
        write_clip(folder / "0" / name, panned_luma(24, 32, 40))
    (folder / "0" / "a.boxes.json").write_text("[]")
    (folder / "0" / "a.json").write_text("{}")
    (folder / "0" / "deep" / "b.masks" / "more").mkdir(parents=True)
    for name in ("000001.png", "more/000002.png"):
        Image.fromarray(np.full((32, 40), 3, np.uint8)).save(folder / "0" / "deep" / "b.masks" / name)
    found = {}
    for form, corpus in packed_forms(folder, tmp_path).items():
        with opened(corpus, tmp_path, processes=int(form == "tar")) as catalogue:
            marks = {ending: dict(each.fingerprints) for ending, each in catalogue.sidecars.items()}
            found[form] = marks, catalogue.facts.sidecars_digest(("masks", "boxes")), catalogue.notes
            for ending, videos in marks.items():
                for video, mark in videos.items():
                    catalogue.check(video, mark, ending)
            source = open_source(str(corpus), SourceOptions())
            masks = marks[".masks/"]["0/deep/b.mp4"]
            with open_sidecar(source, "0/deep/b.masks/", "") as lent:
                table = read_files(lent)[1]
            with open_sidecar(source, "0/deep/b.masks/", masks, table) as lent:
                assert (lent / "more" / "000002.png").read_bytes()[1:4] == b"PNG"
            with open_sidecar(source, "0/a.boxes.json", marks[".boxes.json"]["0/a.mp4"]) as lent:
                assert lent.read_text() == "[]"
            if form != "folder":
                pack(folder / "0" / "deep", corpus / f"0.{form}")
                with pytest.raises(VideoChanged):
                    catalogue.check("0/deep/b.mp4", masks, ".masks/")
                with pytest.raises(VideoGone), open_sidecar(source, "0/a.boxes.json", "1-0"):
                    pass
    assert found["tar"] == found["zip"] == found["folder"]
    assert {ending for ending, videos in found["tar"][0].items() if videos} == {".boxes.json", ".masks/"}


def tar_of(path: Path, *members: tuple[str, bytes], **fields: Any) -> bytes:
    """A tar file; fields of the headers may be replaced."""
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as tar:
        for name, data in members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            for key, value in fields.items():
                setattr(info, key, value)
            tar.addfile(info, io.BytesIO(data))
    return path.read_bytes()


def zip_of(path: Path, *members: tuple[str, bytes], method: int = ZIP_STORED) -> bytes:
    with ZipFile(path, "w", method) as packed:
        for name, data in members:
            packed.writestr(name, data)
    return path.read_bytes()


CLIP = b"no video, but nothing here reads it" * 40
HOSTILE: Mapping[str, tuple[str, Callable[[Path], bytes], Mapping[str, str]]] = {
    "not a tar": (".tar", lambda path: CLIP, {"x.tar": archives.CUT}),
    "not a zip": (".zip", lambda path: CLIP, {"x.zip": archives.CUT}),
    "empty": (".tar", lambda path: b"", {"x.tar": archives.CUT}),
    "cut in a member": (".tar", lambda path: tar_of(path, ("a.mp4", CLIP))[:1000], {"x.tar": archives.CUT}),
    "cut behind a member": (".tar", lambda path: tar_of(path, ("a.mp4", CLIP))[:2048], {"x.tar": archives.CUT}),
    "cut zip": (".zip", lambda path: zip_of(path, ("a.mp4", CLIP))[:-9], {"x.zip": archives.CUT}),
    "zip without its head": (
        ".zip",
        lambda path: b"x" * 20 + zip_of(path, ("a.mp4", CLIP))[20:],
        {"x/a.mp4": "lies beyond the end"},
    ),
    "joined": (".tar", lambda path: 2 * tar_of(path, ("a.mp4", CLIP)), {"x.tar": "has bytes behind its end mark"}),
    "damaged header": (
        ".tar",
        lambda path: tar_of(path, ("a.mp4", CLIP), ("b.mp4", CLIP)).replace(b"b.mp4", b"c.mp4"),
        {"x.tar": archives.CUT},
    ),
    "names that lead out": (
        ".tar",
        lambda path: tar_of(path, ("../a.mp4", CLIP), ("/b.mp4", CLIP), ("x/../../c.mp4", CLIP), ("../d.txt", CLIP)),
        {"x/../a.mp4": archives.LEAVES, "x//b.mp4": archives.LEAVES, "x/x/../../c.mp4": archives.LEAVES},
    ),
    "zip names that lead out": (
        ".zip",
        lambda path: zip_of(path, ("../a.mp4", CLIP), ("/b.mp4", CLIP)),
        {"x/../a.mp4": archives.LEAVES, "x//b.mp4": archives.LEAVES},
    ),
    "a name that steers a terminal": (
        ".tar",
        lambda path: tar_of(path, ("\x1b[31m.mp4", CLIP)),
        {r"x/\x1b[31m.mp4": "not UTF-8"},
    ),
    "a long name": (
        ".tar",
        lambda path: tar_of(path, ("a" * 2000 + ".mp4", CLIP)),
        {"x.tar": "has a name of 2004 characters"},
    ),
    "a link": (
        ".tar",
        lambda path: tar_of(path, ("a.mp4", b""), type=tarfile.SYMTYPE, linkname="/etc/passwd"),
        {"x/a.mp4": "is a link"},
    ),
    "a device": (
        ".tar",
        lambda path: tar_of(path, ("a.mp4", b""), type=tarfile.CHRTYPE),
        {"x/a.mp4": "is a link, or no regular file"},
    ),
    "sparse": (
        ".tar",
        lambda path: tar_of(path, ("a.mp4", CLIP), pax_headers={}, type=tarfile.GNUTYPE_SPARSE),
        {"x/a.mp4": "is sparse"},
    ),
    "compressed": (
        ".zip",
        lambda path: zip_of(path, ("a.mp4", CLIP), ("a.txt", CLIP), ("b.mp4", CLIP), method=ZIP_DEFLATED),
        {"x/a.mp4": "is compressed", "x/b.mp4": "is compressed"},
    ),
    "a file that is a folder": (
        ".tar",
        lambda path: tar_of(path, ("a.mp4", CLIP), ("a.mp4/b.mp4", CLIP)),
        {"x/a.mp4": "is both a file and a folder"},
    ),
    "hidden": (".tar", lambda path: tar_of(path, ("._a.mp4", CLIP), (".b/c.mp4", CLIP)), {}),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_cannot_be_read_in_place_is_refused_in_words(case: str, tmp_path: Path) -> None:
    """Alone: the video beside it is served."""
    ending, make, expected = HOSTILE[case]
    corpus = tmp_path / "corpus"
    write_clip(corpus / "good.mp4", panned_luma(24, 32, 40))
    data = make(tmp_path / f"x{ending}")
    (corpus / f"x{ending}").write_bytes(data)
    with opened(corpus, tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["good.mp4"]
        refused = {each.video: each.reason for each in catalogue.refusals}
    if case == "a file that is a folder":
        del refused["x/a.mp4/b.mp4"]  # is read, and is no video
    assert refused.keys() == expected.keys()
    for id, reason in expected.items():
        assert reason in refused[id]


def test_of_a_name_that_is_there_twice_the_last_counts(tmp_path: Path) -> None:
    clips = [write_clip(tmp_path / f"{n}.mp4", panned_luma(n, 32, 40)).read_bytes() for n in (24, 30)]
    (tmp_path / "corpus").mkdir()
    tar_of(tmp_path / "corpus" / "x.tar", *(("a.mp4", data) for data in clips))
    said = list[str]()
    with opened(
        tmp_path / "corpus", tmp_path, notice=lambda text, is_urgent=False: said.append(text * is_urgent)
    ) as catalogue:
        assert [video.frames for video in catalogue.videos] == [30]
    assert "x.tar: a.mp4 is there more than once: the last one counts, as when it is unpacked" in said


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (["a.tar.gz", "b.tgz"], "2 files left out: compressed tar archives cannot be read in place: decompress them"),
        (
            ["O_part7_partaa", "O_part7_partab"],
            "2 files left out: parts of a split archive: join them, with cat O_part7_part* > O_part7.zip",
        ),
        (["a.zip.001", "a.zip.002"], "2 files left out: parts of a split archive: join them, with cat a.zip.* > a.zip"),
        (["a.z01"], "1 file left out: parts of a split archive: join them, with zip -s 0 a.zip --out whole.zip"),
        (["a.parquet"], "1 file left out: videos in parquet are not read"),
    ],
)
def test_other_archives_are_left_out_in_words(names: list[str], text: str, tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for name in names:
        (corpus / name).touch()
    with pytest.raises(CorpusError, match=re.escape(text)):
        open_catalogue(corpus, cache_dir=tmp_path, processes=0)
    write_clip(corpus / "a.mp4", panned_luma(24, 32, 40))
    with opened(corpus, tmp_path) as catalogue:
        assert (text in catalogue.left_out) is (names != ["a.parquet"])


@pytest.mark.parametrize(
    ("names", "places"),
    [(("a",), [[5, 96]]), (("a",), [[-1, 0]]), (("../a",), [[1, 0]]), (("a\x1b",), [[1, 0]]), (("a", "b"), [[1, 0]])],
)
def test_a_table_that_a_hijacked_process_made_up_is_refused(names: tuple[str, ...], places: list[list[int]]) -> None:
    table = archives.ArchiveTable(names, np.array(places), (), ())
    with pytest.raises(ValueError, match="its table"):
        archives.ArchiveTable.from_bytes(table.to_bytes(), 100)


def _packed(write: Callable[..., bytes]) -> bytes:
    with TemporaryDirectory() as folder:
        return write(Path(folder) / "x", ("a.mp4", CLIP[:600]), ("b.txt", b"x"), ("b.mp4", CLIP[:300]))


_TAR, _ZIP = _packed(tar_of), _packed(zip_of)


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_no_change_of_bytes_ends_the_reading_of_an_archive_otherwise(data: st.DataObject) -> None:
    ending, content = data.draw(st.sampled_from([(".tar", _TAR), (".zip", _ZIP)]))
    changed = bytearray(content)
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), max_size=5)):
        changed[at] = value
    del changed[data.draw(st.integers(0, len(content))) :]
    try:
        table = archives.read_table(io.BytesIO(changed), f"x{ending}", lambda name: name.endswith(".mp4"))
    except ValueError:
        return
    archives.ArchiveTable.from_bytes(table.to_bytes(), len(changed))


def test_a_store_is_prepared_from_archives_as_from_a_folder(forms: Mapping[str, Path], tmp_path: Path) -> None:
    """Also in object storage, also on a host without the copies; and again by the command line."""
    pytest.importorskip("fsspec", reason="the extra 'cloud' is not installed")
    made = {}
    for form, folder in {**forms, "remote": Path(f"file:{forms['tar']}")}.items():
        out, source = tmp_path / "out" / form / "store", str(folder).replace("file:", "file://")
        with opened(source, tmp_path) as catalogue:
            for copy in (tmp_path / "copies").glob("??/*"):
                copy.unlink()
            report = prepare(catalogue, out, processes=int(form in ("tar", "remote")))
            assert len(report.failed) == 0
            assert prepare(catalogue, out, processes=0).kept == len(catalogue.videos)
        files = {
            path.relative_to(out): path.read_bytes()
            for path in out.rglob("*")
            if path.is_file() and path.name[0] != "."
        }
        (manifest,) = [name for name in files if name.name == MANIFEST_NAME]
        lines = files.pop(manifest).splitlines()
        made[form] = files, sorted(lines[1:])
    assert made["folder"] == made["tar"] == made["zip"] == made["remote"]
    assert main([source, str(out), "--cache-dir", str(tmp_path)]) == FAILED, "one file of the corpus is no video"
