"""List files: the paper's columns, and messages that name the line."""

from __future__ import annotations

from pathlib import Path

import pytest

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.sources.source import ListEntry, read_list


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
