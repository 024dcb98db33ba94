"""Which files changed: the same whoever asks, this process or several."""

from __future__ import annotations

import subprocess
import sys
from array import array
from pathlib import Path

import psutil
import pytest

from v2v_server.corpus import changed as module
from v2v_server.corpus.changed import changed
from v2v_server.corpus.sources.folder import Folder

COUNT = 700


Corpus = tuple[Path, list[str], "array[int]"]


@pytest.fixture
def corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Corpus:
    """Files, and what the index knows of them; a process looks at a hundred of them at least."""
    monkeypatch.setattr(module, "_FILES_A_PROCESS", 100)
    monkeypatch.setattr(module, "_TOGETHER", 64)
    ids, states = [f"{number:04d}.mp4" for number in range(COUNT)], array("q")
    for id in ids:
        (tmp_path / id).touch()
        status = (tmp_path / id).stat()
        states.extend((status.st_size, status.st_mtime_ns, status.st_ctime_ns))
    return tmp_path, ids, states


def change(corpus: Corpus) -> list[int]:
    """Changes some files; returns their numbers."""
    folder, ids, states = corpus
    (folder / ids[5]).write_bytes(b"x")
    (folder / ids[699]).unlink()
    (folder / ids[130]).chmod(0o600)  # which only the time of its change of status tells
    states[3 * 300] = -1
    (folder / ids[301]).unlink()
    states[3 * 301 : 3 * 302] = array("q", [-1, 0, 0])  # never known, and not there either
    return [5, 130, 300, 301, 699]


@pytest.mark.parametrize("processes", [0, 1, 3])
def test_a_changed_a_missing_and_an_unknown_file_are_told(corpus: Corpus, processes: int) -> None:
    notices: list[str] = []
    assert changed(Folder(corpus[0]), *corpus[1:], processes, notices.append) == []
    assert notices[-1] == f"looking at files: {COUNT} of {COUNT}, 0 of them new or changed"
    expected = change(corpus)
    assert changed(Folder(corpus[0]), *corpus[1:], processes, notices.append) == expected
    assert notices[-1] == f"looking at files: {COUNT} of {COUNT}, 5 of them new or changed"


@pytest.mark.parametrize("program", ["/nowhere/python", "/bin/false", "/bin/true"])
def test_a_helper_that_does_not_answer_costs_time_only(
    corpus: Corpus, monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    expected = change(corpus)
    monkeypatch.setattr(sys, "executable", program)
    assert changed(Folder(corpus[0]), *corpus[1:], 3, None) == expected


def test_a_script_needs_no_guard_and_a_daemon_may_ask(corpus: Corpus, tmp_path: Path) -> None:
    folder, ids, states = corpus
    script = tmp_path / "script.py"
    script.write_text(
        "from array import array\nfrom pathlib import Path\n"
        "from v2v_server.corpus.sources.folder import Folder\nimport multiprocessing\n"
        "from v2v_server.corpus import changed as module\n"
        f"module._FILES_A_PROCESS = 100\nprint('once')\nmultiprocessing.current_process()._config['daemon'] = True\n"
        f"print(module.changed(Folder(Path({str(folder)!r})), {ids!r}, array('q', {states.tolist()!r}), 3, None))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("once\n[]\n", "")


def test_helpers_end_with_who_asks_them(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    before = set(psutil.Process().children())

    def interrupted(*given: object) -> None:
        assert len(set(psutil.Process().children()) - before) == 2
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_changed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        changed(Folder(corpus[0]), *corpus[1:], 3, None)
    assert set(psutil.Process().children()) <= before
