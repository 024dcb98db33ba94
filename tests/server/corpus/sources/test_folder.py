"""Names that may be shown; many questions at a time, and their answers in order."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import CorpusError
from v2v_protocol.programs import printable
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources import listing as asking
from v2v_server.corpus.sources.folder import MOST_PATHS, PSEUDO, Folder, video_files
from v2v_server.corpus.sources.listing import ListEntry, answers, by_parts, left_out_note, read_list
from v2v_server.corpus.sources.source import open_source

STEERING = {
    "red\x1b[31m.mp4": r"red\x1b[31m.mp4",
    "gone\x7f.mp4": r"gone\x7f.mp4",
    "csi\x9b31m.mp4": r"csi\x9b31m.mp4",
    "evil\u202e4pm.exe.mp4": r"evil\u202e4pm.exe.mp4",
    "isolate\u2067x\u2069.mp4": r"isolate\u2067x\u2069.mp4",
    "mark\u200f.mp4": r"mark\u200f.mp4",
    "line\u2028.mp4": r"line\u2028.mp4",
    "bytes\udcff.mp4": r"bytes\xff.mp4",
}


@pytest.mark.parametrize("name", STEERING)
def test_a_name_that_would_steer_a_terminal_is_shown_escaped_and_refused(tmp_path: Path, name: str) -> None:
    assert printable(name) == STEERING[name]
    (tmp_path / name).touch()
    refused: dict[str, str] = {}
    assert not list(video_files(tmp_path, refused, Counter()))
    assert list(refused) == [STEERING[name]]
    if name.isprintable() or "\udcff" in name or "\u2028" in name:
        return  # no text that a list file could hold in one line
    listed = tmp_path / "list.txt"
    listed.write_text(f"{name}\n", encoding="utf-8")
    with pytest.raises(CorpusError) as caught:
        read_list(listed)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["plain.mp4", "Straße 1.mp4", "映像.mp4", "فیلم‌ها.mp4", "👩‍👩‍👧.mp4"])
def test_names_of_any_language_are_taken_as_they_are(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    assert printable(name) == name
    assert list(video_files(tmp_path, {}, Counter())) == [name]


def test_the_root_of_a_corpus_is_its_folder_or_that_of_its_video_or_list(tmp_path: Path) -> None:
    for name in ("clip.mp4", "list.txt"):
        (tmp_path / name).touch()
        assert open_source(tmp_path / name).folder == tmp_path.resolve()
    assert open_source(tmp_path).folder == tmp_path.resolve()
    with pytest.raises(CorpusError, match="no such folder, video or list file on this host"):
        open_source(tmp_path / "missing")


@pytest.mark.parametrize("files", [0, 1, 63, 64, 65, 1000])
def test_each_is_asked_once_and_answered_in_its_place(files: int) -> None:
    asked: list[int] = []

    def question(file: int) -> int:
        asked.append(file)
        return file * file

    assert list(answers(question, range(files))) == [(file, file * file) for file in range(files)]
    assert sorted(asked) == list(range(files))


def test_what_comes_late_holds_up_no_other_question_and_keeps_its_place() -> None:
    others = threading.Event()

    def question(file: int) -> bool:
        if file == 999:
            others.set()
        return others.wait(60.0) if file == 0 else True

    assert [file for file, in_time in answers(question, range(1000)) if in_time] == list(range(1000))


def test_storage_that_answers_at_once_is_asked_by_one_thread_and_another_by_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, most, sixteen, never = set[int](), [0], threading.Barrier(16, timeout=60.0), threading.Event()

    def question(part: Sequence[int]) -> int:
        now.add(part[0])
        if is_slow:
            sixteen.wait()  # answers once sixteen parts are asked at a time
        else:
            never.wait(0.005)  # another part, if it were asked at the same time, would be seen
        most[0] = max(most[0], len(now))
        now.discard(part[0])
        return sum(part)

    for is_slow, soon_seconds in (False, 60.0), (True, 0.001):
        monkeypatch.setattr(asking, "_SOON_SECONDS", soon_seconds)
        found = list(by_parts(question, range(64 * 48)))
        assert [each for part, _ in found for each in part] == list(range(64 * 48))
        assert all(answer == sum(part) for part, answer in found)
        assert most[0] == (16 if is_slow else 1)


def test_storage_that_was_slow_for_a_while_is_asked_by_one_thread_again(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once: dict[int, int] = {}
    now, ten, never = set[int](), threading.Barrier(10, timeout=60.0), threading.Event()
    monkeypatch.setattr(asking, "_SOON_SECONDS", 0.001)

    def question(part: Sequence[int]) -> None:
        now.add(part[0])
        if part[0] < 640:
            ten.wait()  # the ten first parts answer once all of them are asked
            monkeypatch.setattr(asking, "_SOON_SECONDS", 60.0)
        elif part[0] > 64 * 400:
            never.wait(0.005)
        at_once[part[0]] = len(now)
        now.discard(part[0])

    list(by_parts(question, range(64 * 1000)))
    assert all(count == 1 for first, count in at_once.items() if first > 64 * 400)


@pytest.mark.parametrize("room", [0, 3])
def test_without_room_for_threads_they_are_asked_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    start, started = threading.Thread.start, []

    def limited(thread: threading.Thread) -> None:
        if len(started) == room:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    assert list(answers(lambda file: -file, range(1000))) == [(file, -file) for file in range(1000)]


def test_who_hears_no_more_asks_no_more() -> None:
    threads, asked = threading.active_count(), []

    def question(file: int) -> None:
        asked.append(file)
        time.sleep(0.001)

    heard = answers(question, range(20_000))
    next(heard)
    heard.close()
    assert len(asked) < 20_000
    assert threading.active_count() == threads


def test_folders_linked_to_each_other_are_searched_by_a_bounded_number_of_paths(tmp_path: Path) -> None:
    names = "abcdefgh"
    for name in names:
        (tmp_path / name).mkdir()
        for other in names.replace(name, ""):
            (tmp_path / name / other).symlink_to(tmp_path / other)
    (tmp_path / "a" / "x.mp4").touch()
    refused: dict[str, str] = {}
    found = list(video_files(tmp_path, refused, Counter()))
    assert {"a/x.mp4", *(f"{name}/a/x.mp4" for name in names[1:])} <= set(found)
    assert len(found) <= 8 + MOST_PATHS
    assert len(refused) <= len(names)
    assert all("remove some links" in why for why in refused.values())


def test_a_folder_that_several_links_lead_to_has_its_videos_under_each(tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    (tmp_path / "all" / "x.mp4").touch()
    for number in range(MOST_PATHS + 10):
        (tmp_path / f"link{number}").symlink_to("all")
    refused: dict[str, str] = {}
    assert len(list(video_files(tmp_path, refused, Counter()))) == MOST_PATHS + 11
    assert not refused


def test_links_to_files_of_the_kernel_are_refused(tmp_path: Path) -> None:
    (tmp_path / "proc").symlink_to("/proc")
    (tmp_path / "x.mp4").symlink_to("/proc/kmsg")
    refused: dict[str, str] = {}
    assert not list(video_files(tmp_path, refused, Counter()))
    assert refused == {"proc": PSEUDO, "x.mp4": PSEUDO}
    refused.clear()
    assert not list(Folder(tmp_path, lambda: (ListEntry("x.mp4"),)).videos(refused, Counter()))
    assert refused == {"x.mp4": "is not a regular file"}


def test_other_endings_are_counted_but_for_those_of_no_videos(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.264", "c.ASF", "d.asf", "readme.txt", "x.jpg", "LICENSE", ".hidden.dv"):
        (tmp_path / name).touch()
    left_out: Counter[str] = Counter()
    assert list(video_files(tmp_path, {}, left_out)) == ["a.mp4"]
    assert left_out == {".264": 1, ".asf": 2}
    assert left_out_note(left_out).startswith("3 files have endings that are not looked at and were left out: .264 (1)")
    listed = tmp_path / "list.txt"
    listed.write_text("b.264\nc.ASF 5\n")
    assert [entry.id for entry in read_list(listed)] == ["b.264", "c.ASF"]


@pytest.mark.parametrize(
    ("name", "container", "codec"),
    [
        ("a.asf", "asf", "wmv2"), ("a.264", "h264", "libx264"), ("a.m2t", "mpegts", "libx264"),
        ("a.3g2", "3g2", "libx264"), ("a.f4v", "f4v", "libx264"), ("a.divx", "avi", "mpeg4"), ("a.qt", "mov", "mjpeg"),
        ("a.mp4v", "m4v", "mpeg4"), ("a.m2v", "mpeg2video", "mpeg2video"), ("a.mod", "vob", "mpeg2video"),
        ("a.dv", "dv", "dvvideo"), ("without_ending", "mp4", "libx264"),
    ],
)  # fmt: skip
def test_a_video_of_another_ending_is_served_where_it_is_named(
    tmp_path: Path, name: str, container: str, codec: str
) -> None:
    """A folder's files with such endings are left out: listing them would change every corpus that has some."""
    size, pixel_format = ((576, 720), "yuv420p") if codec == "dvvideo" else ((48, 64), "yuv420p")
    write_clip(
        tmp_path / name, panned_luma(20, *size), codec=codec, container=container,
        pixel_format="yuvj420p" if codec == "mjpeg" else pixel_format, full_range=codec == "mjpeg",
    )  # fmt: skip
    (tmp_path / "list.txt").write_text(f"{name}\n")
    sources = [tmp_path / name, tmp_path / "list.txt"] if "." in name else [tmp_path / name]
    for source in sources:
        with closing(open_catalogue(source, cache_dir=tmp_path / "cache", processes=0)) as catalogue:
            assert [video.frames for video in catalogue.videos] == [20]


# --- list files -------------------------------------------------------------------------------------------------------


def written(tmp_path: Path, text: str, name: str = "list.txt") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


def test_all_forms(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "\ufeff# the list\r\na/b.mp4 450 0.2 0.3\r\n\r\nc.mp4\nd with 2 spaces.mp4 30\n"
        "  ./e//f.webm 12 0.5\ng 3.mp4\t7\n",
    )
    assert read_list(path) == (
        ListEntry("a/b.mp4", 450, 0.2, 0.3),
        ListEntry("c.mp4"),
        ListEntry("d with 2 spaces.mp4", 30),
        ListEntry("e/f.webm", 12, 0.5, 0.5),
        ListEntry("g 3.mp4", 7),
    )


def test_commas(tmp_path: Path) -> None:
    path = written(tmp_path, 'path,frames,c+,c-\n"a, b.mp4",450,0.2,0.3\nc.mp4\n', "list.csv")
    assert read_list(path) == (ListEntry("a, b.mp4", 450, 0.2, 0.3), ListEntry("c.mp4"))


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("/a.mp4", "absolute"),
        ("C:\\a.mp4", "absolute"),
        ("../a.mp4 3", "leaves the folder"),
        ("a/../../b.mp4", "leaves the folder"),
        ("a.mp4 0", "frames"),
        ("a.mp4 1.5", "frames"),
        ("a.mp4 10 -0.1 0.2", "above 0"),
        ("a.mp4 10 0.1 0.2 0.3", "0.1 frames"),
        ("a.mp4 ten", "does not name a video file"),
        ("450", "does not name a video file"),
        ("a\x00b.mp4", "control characters"),
        ("good.mp4", "listed already in line 1"),
    ],
)
def test_nonsense_names_its_line(tmp_path: Path, line: str, why: str) -> None:
    with pytest.raises(CorpusError, match=f"line 2: .*{why}"):
        read_list(written(tmp_path, f"good.mp4 5\n{line}\n"))


def test_webvids_own_table(tmp_path: Path) -> None:
    rows = 'videoid,contentUrl,duration,page_dir,name\n21179416,https://x/1.mp4,PT00H00M11S,006001_006050,"A, b"\n'
    assert [entry.id for entry in read_list(written(tmp_path, rows, "list.csv"))] == ["006001_006050/21179416.mp4"]
    with pytest.raises(CorpusError, match="line 3: 2 columns, fewer than the heading has"):
        read_list(written(tmp_path, rows + "1,2\n", "list.csv"))


@pytest.mark.parametrize(
    ("line", "why"), [("a.mp4,ten", "not a number"), ("a.mp4,1,2,3,4", "5 columns"), ('"a', "line 1")]
)
def test_nonsense_with_commas(tmp_path: Path, line: str, why: str) -> None:
    with pytest.raises(CorpusError, match=why):
        read_list(written(tmp_path, line, "list.csv"))


def test_files_that_are_no_list(tmp_path: Path) -> None:
    with pytest.raises(CorpusError, match="cannot be read"):
        read_list(tmp_path / "missing.txt")
    with pytest.raises(CorpusError, match="names no video"):
        read_list(written(tmp_path, "# nothing\n"))
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(CorpusError, match="not UTF-8"):
        read_list(tmp_path / "binary.txt")
