"""Run the examples of docs/guides/frameworks.md unchanged: each stops, resumes, and takes every sample once."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.client.fake_server import FakeServer
from v2v_client import Batch, V2VStreamDataset

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "guides" / "frameworks.md"
(FIRST_LINES,) = re.findall(
    r"follows these lines.*?```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S
)
EXAMPLES = re.findall(r"^## (.+?)\n\n```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


OTHERS = ("torchrun", "Lightning", "accelerate")
"""Examples that a framework runs, and not a plain loop."""
OURS = {name: text for name, text in EXAMPLES if name not in OTHERS}


class Crash(Exception):
    pass


def names_for(server: FakeServer, train: Callable[[Batch], None]) -> dict[str, Any]:
    """The names of the page's first lines, with the address of a server and a training step of the test."""
    names: dict[str, Any] = {}
    exec(FIRST_LINES, names)
    return names | {"ADDRESS": server.address, "train": train}


def of_two_bins(text: str) -> str:
    """Adapt an example to the fake server's grids of two bins."""
    assert "Conv2d(5," in text
    return text.replace("Conv2d(5,", "Conv2d(2,")


def test_the_page_has_examples() -> None:
    assert [name for name, _ in EXAMPLES] == ["DataLoader", "StatefulDataLoader", *OTHERS]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's, of a fork in a process with threads
@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning")  # torchdata calls it
@pytest.mark.parametrize("text", OURS.values(), ids=OURS)
def test_an_example_resumes_where_it_was(text: str) -> None:
    taken: list[int] = []

    def train(batch: Batch) -> None:
        taken.extend(batch.indices)

    with FakeServer(sequences=23, credit=8) as server:
        exec(text, names_for(server, train))
    assert taken == list(range(20))


RANK = """
from pathlib import Path

ADDRESS = {address!r}
trained = 0


def train(batch):
    global trained
    torch.distributed.barrier()  # as backward() of a network that all ranks train: none is ahead by more than a batch
    if trained == 1 and Path("first").exists():
        raise SystemExit("a crash")
    trained += 1
    with Path("taken").open("a") as file:
        print(*batch.indices, file=file)


"""


@pytest.mark.slow
def test_the_example_of_torchrun_resumes_where_it_was(tmp_path: Path) -> None:
    """All ranks crash in their second batch, and the same command resumes. 23 sequences, 2 ranks and batches of 4 make
    two batches for each rank."""
    text = dict(EXAMPLES)["torchrun"]
    (command,) = re.findall(r"^ {4}torchrun (.*)$", PAGE.read_text(encoding="utf-8"), re.M)
    with FakeServer(sequences=23, credit=8) as server:
        (tmp_path / "train.py").write_text(FIRST_LINES + RANK.format(address=server.address) + text, encoding="utf-8")
        (tmp_path / "first").touch()
        first = torchrun(command, tmp_path)
        (tmp_path / "first").unlink()
        second = torchrun(command, tmp_path)
    assert first.returncode == 1, first.stderr
    assert "a crash" in first.stderr
    assert second.returncode == 0, second.stderr
    taken = [int(index) for index in (tmp_path / "taken").read_text().split()]
    assert sorted(taken) == list(range(16))


def torchrun(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the command as a shell would, in this environment. SIGTERM of `timeout` also ends its ranks."""
    return subprocess.run(
        ["timeout", "120", sys.executable, "-m", "torch.distributed.run", *command.split()],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # theirs, of each other and of torch
def test_the_example_of_accelerate_resumes_where_it_was() -> None:
    taken: list[int] = []
    with FakeServer(sequences=23, credit=8) as server:
        exec(of_two_bins(dict(EXAMPLES)["accelerate"]), names_for(server, lambda batch: taken.extend(batch.indices)))
    assert taken == list(range(20))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # theirs, of each other and of torch
@pytest.mark.parametrize(
    ("kind", "workers"), [(None, 0), (DataLoader, 0), (DataLoader, 2), (StatefulDataLoader, 0), (StatefulDataLoader, 2)]
)
def test_the_example_of_lightning_resumes_where_its_checkpoint_was(tmp_path: Path, kind: Any, workers: int) -> None:
    """The checkpoint is written after two batches; the crash is in the fourth."""
    taken: list[int] = []

    def train(batch: Batch) -> None:
        if batch.indices[0] == 12 and 12 not in crashed:
            crashed.append(12)
            raise Crash
        taken.extend(batch.indices)

    def loader(stream: V2VStreamDataset, *, batch_size: None, num_workers: int) -> Any:
        return stream if kind is None else kind(stream, batch_size=batch_size, num_workers=workers)

    crashed: list[int] = []
    quiet = {"accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    text = of_two_bins(dict(EXAMPLES)["Lightning"]).replace("max_epochs=1,", "max_epochs=1, **QUIET,")
    first, second = text.replace('"runs/lightning"', repr(str(tmp_path))).split("  # a crash\n")
    with FakeServer(sequences=23, credit=8) as server:
        names = names_for(server, train) | {"DataLoader": loader, "QUIET": quiet}
        with pytest.raises(Crash):
            exec(first, names)
        assert taken == list(range(12))
        del taken[8:]  # what came after the checkpoint is trained on again
        exec(second, names)
    assert taken == list(range(20))
