"""`v2v-quarantine`: what it shows, what it clears, and how it ends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from v2v_server.commands.quarantine import main
from v2v_server.quarantine import Quarantine, QuarantineEntry, quarantine_path, read_quarantine, write_entry

TIME = "2024-02-29T12:00:00+00:00"


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    (tmp_path / "videos").mkdir()
    return tmp_path / "videos"


def run(corpus: Path, *more: str) -> int:
    return main(["--videos", str(corpus), "--cache-dir", str(corpus.parent / "cache"), *more])


def fill(corpus: Path, *frames: int) -> Path:
    """A server writes verdicts on these sequences."""
    file = quarantine_path(corpus.resolve(), corpus.parent / "cache")
    quarantine = read_quarantine(file)
    for frame in frames:
        verdict = QuarantineEntry(0, "a/v.mp4", "f", frame, "a worker was ended by SIGSEGV over it", TIME)
        quarantine.extend(write_entry(file, verdict, quarantine))
    return file


def test_of_object_storage_nothing_is_asked_or_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--videos", "s3://bucket/videos/", "--cache-dir", str(tmp_path / "cache")]) == 0
    file = quarantine_path("s3://bucket/videos", tmp_path / "cache")
    assert capsys.readouterr().out == f"snapshot 0 holds 0 entries ({file})\n"
    assert not (tmp_path / "cache").exists()


def test_verdicts_are_listed_with_whether_they_hold(corpus: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = fill(corpus, 40)
    run(corpus, "--clear")
    fill(corpus, 80)
    capsys.readouterr()
    run(corpus)
    first, second, third, last = capsys.readouterr().out.splitlines()
    said = f"({TIME}): a/v.mp4 from frame {{}}: a worker was ended by SIGSEGV over it"
    assert first == "not now   snapshot 1 " + said.format(40)
    assert second.startswith("not now   snapshot 2 (")
    assert second.endswith("): cleared")
    assert third == "in force  snapshot 3 " + said.format(80)
    assert last == f"snapshot 3 holds 1 entries ({file})"


def test_clearing_begins_a_snapshot_only_when_there_is_something_to_clear(
    corpus: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(corpus, "--clear")
    file = fill(corpus, 40, 80)
    for _ in range(2):
        run(corpus, "--clear")
        assert capsys.readouterr().out.splitlines()[-1].startswith("snapshot 3 holds 0 entries")
    quarantine = read_quarantine(file)
    assert [len(quarantine.entries(number)) for number in range(4)] == [0, 1, 2, 0]


def test_json_has_a_record_a_line(corpus: Path, tmp_path: Path) -> None:
    file = fill(corpus, 40)
    run(corpus, "--clear", "--json", str(tmp_path / "out.json"))
    records = json.loads((tmp_path / "out.json").read_text())
    assert [(record["snapshot"], record["path"], record["in_force"]) for record in records] == [
        (1, "a/v.mp4", False),
        (2, "", False),
    ]
    fields = [{key: value for key, value in record.items() if key != "in_force"} for record in records]
    assert Quarantine(QuarantineEntry(**each) for each in fields).lines == read_quarantine(file).lines


@pytest.mark.parametrize("source", ["folder", "video", "list"])
def test_the_corpus_is_found_as_a_server_finds_it(
    corpus: Path, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    fill(corpus, 40)
    (corpus / "v.mp4").touch()
    (corpus / "list.txt").touch()
    path = corpus / {"folder": ".", "video": "v.mp4", "list": "list.txt"}[source]
    main(["--videos", str(path), "--cache-dir", str(corpus.parent / "cache")])
    assert "snapshot 1 holds 1 entries" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("damage", "status", "text"),
    [
        ("missing corpus", 2, "there is no such folder, video or list file"),
        ("corpus that cannot be read", 2, "cannot be read: File name too long"),
        ("damaged line", 2, "line 1 is damaged"),
        ("json is a folder", 2, "--json"),
        ("unwritable", 1, "nothing was cleared"),
    ],
)
def test_failures_end_in_one_line_and_a_status(
    corpus: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    damage: str,
    status: int,
    text: str,
) -> None:
    file = fill(corpus, 40)
    more = ["--clear"]
    if damage == "missing corpus":
        corpus.rmdir()
    elif damage == "corpus that cannot be read":
        corpus = corpus / ("x" * 300)
    elif damage == "damaged line":
        file.write_text("damaged\n")
    elif damage == "json is a folder":
        more = ["--json", str(corpus)]
    else:

        def full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
    assert run(corpus, *more) == status
    captured = capsys.readouterr()
    assert captured.err.startswith("v2v-quarantine: ")
    assert text in captured.err
    assert len(captured.err.splitlines()) == 1
    assert captured.out == ""
    if damage == "unwritable":
        monkeypatch.undo()
        assert read_quarantine(file).latest == 1
