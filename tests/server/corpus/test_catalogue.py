"""The catalogue: stable names, incremental probing, and files that misbehave."""

from __future__ import annotations

import errno
import os
import pwd
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.server.corpus.failing_storage import failing_opens
from tests.server.video.lethal_reads import always_killed, killed_once, lethal, waiting
from v2v_protocol.errors import CorpusError, IndexUnreadable, UsageError, VideoChanged, VideoError
from v2v_server.corpus import catalogue as catalogue_module
from v2v_server.corpus import index as index_file
from v2v_server.corpus import probe as probe_module
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.probe import probe_files
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.listing import silent
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.corpus_words import notes_of
from v2v_server.video.fingerprint import check_fingerprint, fingerprint, is_same_file
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.rows import Rows


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("sample") / "clip.mp4", panned_luma(30), b_frames=2)


@pytest.fixture
def corpus(tmp_path: Path, sample: Path) -> Path:
    for name in ("a.mp4", "sub/b.mp4", "sub/deep/c with space.MP4"):
        target = tmp_path / "corpus" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(sample, target)
    return tmp_path / "corpus"


class Opener:
    """Opens catalogues with one cache, closes them in the end, and counts the files probed."""

    def __init__(self, cache: Path) -> None:
        self.cache = cache
        self.probed: list[int] = []
        self.opened: list[Catalogue] = []

    def __call__(self, source: Path, **more: object) -> Catalogue:
        steps: list[tuple[int, int]] = []
        settings = {"cache_dir": self.cache, "processes": 0, "progress": lambda *step: steps.append(step)} | more
        catalogue = open_catalogue(source, **settings)  # type: ignore[arg-type]
        assert [done for done, _ in steps] == list(range(1, len(steps) + 1))
        assert {total for _, total in steps} <= {len(steps)}
        self.probed.append(len(steps))
        self.opened.append(catalogue)
        return catalogue


@pytest.fixture
def opener(tmp_path: Path):  # type: ignore[no-untyped-def]
    opener = Opener(tmp_path / "cache")
    yield opener
    for catalogue in opener.opened:
        catalogue.close()


def ids(catalogue: Catalogue) -> list[str]:
    return [video.id for video in catalogue.videos]


def test_a_folder(corpus: Path, opener: Opener) -> None:
    (corpus / ".hidden.mp4").write_bytes(b"x")
    (corpus / ".cache").mkdir()
    shutil.copy(corpus / "a.mp4", corpus / ".cache" / "d.mp4")
    (corpus / "notes.md").write_text("x")
    (corpus / "sub" / "loop").symlink_to(corpus)
    (corpus / "broken.mp4").symlink_to(corpus / "nowhere.mp4")
    (corpus / "circle.mp4").symlink_to(corpus / "circle.mp4")
    catalogue = opener(corpus)
    assert ids(catalogue) == ["a.mp4", "sub/b.mp4", "sub/deep/c with space.MP4"]
    assert [(refusal.video, refusal.reason) for refusal in catalogue.refusals] == [
        ("broken.mp4", "is not a regular file, or is a broken link"),
        ("circle.mp4", "cannot be read: Too many levels of symbolic links"),
    ]
    video = catalogue.videos[0]
    assert (video.frames, video.width_px, video.height_px, video.codec) == (30, 64, 48, "h264")
    assert video.frames_per_second == pytest.approx(25)
    assert is_same_file(video.fingerprint, fingerprint(corpus / "a.mp4"))
    assert catalogue.path("sub/b.mp4") == (corpus / "sub/b.mp4").resolve()
    np.testing.assert_array_equal(catalogue.frame_index("a.mp4").seconds(0, 30), np.arange(30) / 25)
    assert catalogue.notes == ()


def denied_at(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Permission is denied to look at this path and what lies below it."""
    looked = os.stat

    def denied(path: object, *more: object, **options: object) -> os.stat_result:
        if f"{os.fspath(path)}/".startswith(f"{place}/"):  # type: ignore[call-overload]
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        return looked(path, *more, **options)  # type: ignore[call-overload,no-any-return]

    monkeypatch.setattr(os, "stat", denied)


def test_an_index_keeps_what_cannot_be_looked_at_today(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = opener(corpus)
    with monkeypatch.context() as patch:
        denied_at(corpus / "sub", patch)
        locked = opener(corpus)
    assert ids(locked) == ["a.mp4"]
    assert [refusal.video for refusal in locked.refusals] == ["sub"]
    assert locked.notes == ()
    again = opener(corpus)
    assert again.digest == first.digest
    assert opener.probed == [3, 0, 0]


@pytest.mark.parametrize("where", ["", MANIFEST_NAME])
def test_a_corpus_that_cannot_be_looked_at_is_one_line(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    denied_at(corpus / where, monkeypatch)
    with pytest.raises(CorpusError, match=rf"^{corpus}: cannot be read: Permission denied$"):
        opener(corpus)


def test_a_folder_that_may_be_listed_but_not_entered_keeps_nobody_out(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    denied_at(corpus / "sub" / MANIFEST_NAME, monkeypatch)
    assert len(opener(corpus).videos) == 3


def test_storage_is_asked_twice_and_again_at_the_next_start(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = opener(corpus, cache_dir=corpus.parent / "other").digest
    left = failing_opens(monkeypatch, a=2, b=1)
    first = opener(corpus)
    assert [(refusal.video, refusal.reason) for refusal in first.refusals] == [
        ("a.mp4", "cannot be opened: Input/output error")
    ]
    assert left == {"a": 0, "b": 0}
    assert opener(corpus).digest == whole
    assert opener.probed == [3, 3, 1]


def test_the_second_start_probes_only_what_changed(corpus: Path, opener: Opener) -> None:
    first = opener(corpus)
    again = opener(corpus)
    assert again.digest == first.digest
    assert again.videos == first.videos
    write_clip(corpus / "a.mp4", panned_luma(12))
    changed = opener(corpus)
    (corpus / "sub" / "b.mp4").unlink()
    shutil.copy(corpus / "a.mp4", corpus / "new.mp4")
    moved = opener(corpus)
    assert opener.probed == [3, 0, 1, 1]
    assert [video.frames for video in changed.videos] == [12, 30, 30]
    assert ids(moved) == ["a.mp4", "new.mp4", "sub/deep/c with space.MP4"]
    assert len({first.digest, changed.digest, moved.digest}) == 3
    with pytest.raises(VideoChanged, match="has changed since this catalogue was opened"):
        first.frame_index("a.mp4")
    with pytest.raises(CorpusError, match="is not in this catalogue"):
        moved.frame_index("sub/b.mp4")


def test_a_video_replaced_in_its_middle_is_another_one(corpus: Path, opener: Opener) -> None:
    path = write_clip(corpus / "long.avi", panned_luma(60, 96, 128), codec="rawvideo")
    first = opener(corpus)
    content = bytearray(path.read_bytes())
    assert len(content) > 3 * 65536
    status = path.stat()
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # its size and this time are what they were
    changed = opener(corpus)
    assert opener.probed == [4, 1]
    before, after = (next(v for v in each.videos if v.id == "long.avi").fingerprint for each in (first, changed))
    assert is_same_file(before, fingerprint(path))  # head and tail are what they were
    assert not is_same_file(before, after)
    assert first.digest != changed.digest


def test_a_video_that_is_doubted_is_probed_at_the_next_start_and_served_until_then(
    corpus: Path, opener: Opener
) -> None:
    first = opener(corpus)
    first.mark_stale("a.mp4")
    assert len(first.frame_index("a.mp4")) == 30
    first.fail_fast()
    with closing(sqlite3.connect(next(opener.cache.iterdir()), isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        first.mark_stale("sub/b.mp4")  # another process writes: neither waited for nor an error
        other.execute("ROLLBACK")
    assert opener(corpus).digest == first.digest
    opener(corpus)
    assert opener.probed == [3, 1, 0]


@pytest.mark.parametrize("step", ["fingerprint", "facts_of"])
def test_a_video_that_is_a_pipe_for_a_moment_is_not_condemned(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path, aside = corpus / "a.mp4", corpus / "aside"
    work = getattr(probe_module, step)

    def in_that_moment(of: Path, *kind: str) -> object:
        if of != path:
            return work(of, *kind)
        path.rename(aside)
        os.mkfifo(path)
        try:
            return work(of, *kind)
        finally:
            aside.rename(path)

    with monkeypatch.context() as patch:
        patch.setattr(probe_module, step, in_that_moment)
        (problem,) = opener(corpus).refusals
    assert (problem.video, problem.reason) == ("a.mp4", "is not a regular file")
    assert len(opener(corpus).videos) == 3


def test_a_video_that_changes_while_it_is_probed_is_probed_again(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = probe_module.facts_of

    def meanwhile(path: Path, *kind: str) -> object:
        facts = work(path, *kind)
        if path.name == "a.mp4":
            write_clip(path, panned_luma(12))
        return facts

    with monkeypatch.context() as patch:
        patch.setattr(probe_module, "facts_of", meanwhile)
        (problem,) = opener(corpus).refusals
    assert problem.reason == "changes while it is read; the next start tries again"
    assert [video.frames for video in opener(corpus).videos] == [12, 30, 30]


def test_what_a_list_names_is_not_opened_unless_it_is_a_file(corpus: Path, opener: Opener) -> None:
    """A named pipe would be waited for until somebody writes into it."""
    os.mkfifo(corpus / "pipe.mp4")
    (corpus / "endless.mp4").symlink_to("/dev/zero")
    (corpus / "folder.mp4").mkdir()
    listed = corpus / "list.txt"
    listed.write_text("pipe.mp4\nendless.mp4\nfolder.mp4\na.mp4\ngone.mp4\n")
    catalogue = opener(listed)
    assert ids(catalogue) == ["a.mp4"]
    reasons = {refusal.video: refusal.reason for refusal in catalogue.refusals}
    assert reasons.pop("gone.mp4").startswith("cannot be read: No such file")
    assert reasons == dict.fromkeys(("pipe.mp4", "endless.mp4", "folder.mp4"), "is not a regular file")
    listed.write_text("pipe.mp4\n")
    with pytest.raises(CorpusError, match=r"no video found.*pipe\.mp4: is not a regular file"):
        opener(listed)


def test_lists(corpus: Path, opener: Opener) -> None:
    listed = corpus / "list.txt"
    listed.write_text("sub/b.mp4 99 0.2 0.3\na.mp4\ngone.mp4 5\n")
    by_source, by_option = opener(listed), opener(corpus, list_file=listed)
    assert by_source.digest == by_option.digest != opener(corpus, list_file=listed, rows=Rows.parse("top:0.54")).digest
    assert ids(by_source) == ["a.mp4", "sub/b.mp4"]
    assert [(video.threshold_pos, video.threshold_neg) for video in by_source.videos] == [(None, None), (0.2, 0.3)]
    assert [refusal.video for refusal in by_source.refusals] == ["gone.mp4"]
    assert notes_of(by_source) == ["1 video is shorter than the list states: sub/b.mp4 has 30 frames, not 99"]
    # The part that the list leaves out stays in the index.
    opener(corpus)
    opener(listed)
    assert opener.probed == [3, 1, 1, 1, 1]


def test_interlaced_videos_are_said_at_each_start(corpus: Path, opener: Opener) -> None:
    write_clip(corpus / "fields.mp4", panned_luma(30, 64, 64), options={"x264-params": "interlaced=1"})
    for catalogue in (opener(corpus), opener(corpus)):
        assert len(catalogue.videos) == 4
        (note,) = notes_of(catalogue)
        assert note.startswith("1 video is interlaced (fields.mp4): the frames are served as they are stored")
    assert opener.probed == [4, 0]


def test_nothing_to_serve(tmp_path: Path, opener: Opener) -> None:
    with pytest.raises(CorpusError, match="there is no such folder"):
        opener(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CorpusError, match=r"no video found; looked for .*mp4"):
        opener(tmp_path / "empty")
    (tmp_path / "empty" / "bad.mp4").write_bytes(b"x")
    with pytest.raises(CorpusError, match="none of 1 videos can be used"):
        opener(tmp_path / "empty")
    with pytest.raises(CorpusError, match="not a folder"):
        opener(tmp_path / "empty" / "bad.mp4", list_file=tmp_path / "list.txt")


@pytest.mark.parametrize("content", [b"this is no database at all" * 100, None])
def test_an_index_that_cannot_be_used(corpus: Path, opener: Opener, content: bytes | None) -> None:
    good = opener(corpus)
    path = next(opener.cache.iterdir())
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    catalogue = opener(corpus)
    assert catalogue.digest == good.digest
    assert str(path) in catalogue.notes[0]
    assert len(catalogue.frame_index("a.mp4")) == 30


def test_a_full_disk(corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = sqlite3.connect

    def small(path: object, **more: object) -> sqlite3.Connection:
        database = connect(path, **more)  # type: ignore[call-overload]
        if str(opener.cache) in str(path):
            database.execute("PRAGMA max_page_count = 3")
        return database  # type: ignore[no-any-return]

    monkeypatch.setattr(sqlite3, "connect", small)
    for number in range(25):
        shutil.copy(corpus / "a.mp4", corpus / f"{'long name ' * 15}{number}.mp4")
    catalogue = opener(corpus, progress=silent)
    assert len(catalogue.videos) == 28
    assert "full" in catalogue.notes[0]


def test_where_the_index_lies(corpus: Path, opener: Opener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("V2V_CACHE_DIR", raising=False)
    opener(corpus, cache_dir=None)
    assert len(list((tmp_path / "xdg" / "v2v").iterdir())) == 1
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "chosen"))
    opener(corpus, cache_dir=None)
    assert len(list((tmp_path / "chosen").iterdir())) == 1


def test_a_user_without_a_home_is_told_where_to_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("V2V_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)

    def unknown(user: int) -> None:
        raise KeyError(user)

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    with pytest.raises(CorpusError, match=r"no home folder .* --cache-dir or V2V_CACHE_DIR"):
        index_path(tmp_path, None)
    assert index_path(tmp_path, tmp_path).parent == tmp_path


def test_a_file_that_kills_its_reader_costs_only_itself(corpus: Path) -> None:
    shutil.copy(corpus / "a.mp4", corpus / "lethal.mp4")
    names = ["a.mp4", "lethal.mp4", "sub/b.mp4"]
    records = {record.id: record for record in probe_files(Folder(corpus), names, 1, lethal)}
    assert set(records) == set(names)
    assert records["lethal.mp4"].problem == "crashes the decoder: the process that probed it died (signal SIGSEGV)"
    assert records["lethal.mp4"].size_bytes == (corpus / "lethal.mp4").stat().st_size  # not to be tried again
    assert [records[id].frames for id in ("a.mp4", "sub/b.mp4")] == [30, 30]


def test_a_file_is_not_blamed_for_a_process_killed_from_outside(corpus: Path) -> None:
    (record,) = probe_files(Folder(corpus), ["a.mp4"], 1, killed_once)
    assert (record.id, record.problem) == ("a.mp4", None)
    (record,) = probe_files(Folder(corpus), ["a.mp4"], 1, always_killed)
    assert "twice (signal SIGKILL), which says nothing of the file" in (record.problem or "")
    assert record.size_bytes == -1  # which no file has: the next start tries again


def test_processes_that_cannot_start_poison_no_index(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = sys.executable
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(UsageError, match="ended during its start"):
        open_catalogue(corpus, cache_dir=opener.cache, processes=1)
    monkeypatch.setattr(sys, "executable", python)
    assert len(opener(corpus).videos) == 3


@pytest.mark.slow
def test_a_file_that_is_waited_for_in_vain_costs_only_itself(corpus: Path) -> None:
    names = ["a.mp4", "waiting.mp4", "sub/b.mp4"]
    records = {record.id: record for record in probe_files(Folder(corpus), names, 2, waiting, longest_seconds=10.0)}
    assert [id for id, record in records.items() if record.problem is not None] == ["waiting.mp4"]
    assert records["waiting.mp4"].size_bytes == -1  # to be tried again
    assert "ended after 10 s without a result; the next start" in str(records["waiting.mp4"].problem)


def test_fingerprints(tmp_path: Path) -> None:
    path = tmp_path / "file"
    content = bytearray(np.random.default_rng(1).bytes(300_000))
    seen = set()
    for position in (None, 0, 65_535, 234_465, 299_999):
        changed = bytearray(content)
        if position is not None:
            changed[position] ^= 1
        path.write_bytes(changed)
        seen.add(fingerprint(path))
    assert len(seen) == 5
    check_fingerprint(path, fingerprint(path))
    path.write_bytes(content[:-1])
    with pytest.raises(VideoChanged, match="299999-"):
        check_fingerprint(path, max(seen))
    path.unlink()
    with pytest.raises(VideoError, match="cannot be read: No such file"):
        check_fingerprint(path, max(seen))


@pytest.mark.parametrize(("limit", "most"), [("_SMALL_INDEX_BYTES", 60), ("_SMALL_INDEX_FRAMES", 119)])
def test_a_small_index_is_handed_on_whole_and_of_a_large_one_the_encoded_slice_the_latest_of_which_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int
) -> None:
    folder = write_clip(tmp_path / "clips" / "a.mp4", panned_luma(120), gop=12).parent
    with closing(open_catalogue(folder, processes=0)) as catalogue:
        whole = catalogue.frame_index("a.mp4").to_bytes()
        assert {catalogue.frame_index_bytes("a.mp4", start, 20) for start in (0, 50, 100)} == {whole}
    monkeypatch.setattr(catalogue_module, limit, most)
    monkeypatch.setattr(catalogue_module, "PIECE_FRAMES", 16)
    with closing(open_catalogue(folder, processes=0)) as catalogue:
        first = catalogue.frame_index_bytes("a.mp4", 0, 20)
        assert catalogue.frame_index_bytes("a.mp4", 0, 20) is first
        for start in range(1, 100):
            first_frame, end = start // 16 * 16, min(-(-(start + 20) // 16) * 16, 120)
            expected = catalogue.frame_index("a.mp4").slice(first_frame, end - first_frame).to_bytes()
            assert catalogue.frame_index_bytes("a.mp4", start, 20) == expected
        again = catalogue.frame_index_bytes("a.mp4", 0, 20)
        assert again == first
        assert again is not first
        with pytest.raises(UsageError, match="asked of an index"):
            catalogue.frame_index_bytes("a.mp4", 110, 20)


def test_an_index_that_another_process_holds_is_said_at_once(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue = opener(corpus)
    catalogue.fail_fast()
    assert catalogue._store._database.execute("PRAGMA busy_timeout").fetchone() == (0,)
    name = ids(catalogue)[0]
    (file,) = (file for _, _, file in catalogue._store._database.execute("PRAGMA database_list"))
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(IndexUnreadable, match="locked"):
            catalogue.frame_index_bytes(name, 0, 3)
        other.execute("ROLLBACK")
    assert catalogue.frame_index_bytes(name, 0, 3)


def test_a_start_says_soon_that_another_process_holds_the_index_and_again_how_it_went(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    opener(corpus).close()
    (file,) = opener.cache.glob("catalogue-*.sqlite3")
    monkeypatch.setattr(index_file, "_SAY_SECONDS", 0.2)
    said: list[str] = []
    with closing(sqlite3.connect(file, isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN EXCLUSIVE")

        def notice(text: str, *, is_urgent: bool = False) -> None:
            if is_urgent:
                said.append(text)
                if len(said) == 1:
                    other.execute("ROLLBACK")

        assert opener(corpus, notice=notice).notes == ()
    assert [text.partition(":")[0] for text in said] == [
        f"another process holds the catalogue's index {file}", f"the catalogue's index {file} is free again",
    ]  # fmt: skip
    monkeypatch.setattr(index_file, "_BUSY_SECONDS", 0.5)
    said.clear()
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        (note,) = opener(corpus, notice=lambda text, *, is_urgent=False: said.append(text) if is_urgent else None).notes
    assert "keeps it in memory" in note
    assert "waiting for at most 0.5 s" in said[0]
    assert "cannot be used (database is locked): probing every video again" in said[1]


def test_an_index_behind_a_link_keeps_its_targets_mode(corpus: Path, opener: Opener, tmp_path: Path) -> None:
    opener(corpus).close()
    (file,) = opener.cache.glob("catalogue-*.sqlite3")
    target = tmp_path / "shared.sqlite3"
    file.rename(target)
    target.chmod(0o664)
    file.symlink_to(target)
    assert opener(corpus).notes == ()
    assert target.stat().st_mode & 0o777 == 0o664


def test_the_index_of_a_long_video_is_opened_once(
    corpus: Path, opener: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a day takes a tenth of a second in the broker's only thread, and every lease asked for it."""
    monkeypatch.setattr(catalogue_module, "_SMALL_INDEX_BYTES", 40)
    catalogue = opener(corpus)
    opened: list[int] = []
    from_bytes = FrameIndex.from_bytes

    def opening(data: bytes) -> FrameIndex:
        opened.append(len(data))
        return from_bytes(data)

    monkeypatch.setattr(FrameIndex, "from_bytes", opening)
    names = ids(catalogue)[:2]
    for start in (0, 5, 10, 5):
        for name in names:
            catalogue.frame_index_bytes(name, start, 3)
    assert len(opened) == 2
    monkeypatch.setattr(catalogue_module, "_KEPT_LONG_FRAMES", 1)
    catalogue._long.clear()
    for start in (1, 2, 3):
        for name in names:
            catalogue.frame_index_bytes(name, start, 3)
            assert list(catalogue._long) == [name]
