"""The examples of docs/guides/frameworks.md, as they stand there: each stops, resumes, and takes every sample once."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.client.fake_server import FakeServer
from v2v_client import Batch, V2VStreamDataset

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "frameworks.md"
EXAMPLES = re.findall(r"^## (.+?)\n\n```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


def test_there_are_examples() -> None:
    assert [name for name, _ in EXAMPLES] == ["A plain loop", "DataLoader", "StatefulDataLoader"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's, of a fork in a process with threads
@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning")  # torchdata calls it
@pytest.mark.parametrize("text", [text for _, text in EXAMPLES], ids=[name for name, _ in EXAMPLES])
def test_an_example_resumes_where_it_was(text: str) -> None:
    taken: list[int] = []

    def train(batch: Batch) -> None:
        taken.extend(batch.indices)

    with FakeServer(sequences=23, credit=8) as server:
        names = {"ADDRESS": server.address, "train": train, "V2VStreamDataset": V2VStreamDataset}
        exec(text, names | {"DataLoader": DataLoader, "StatefulDataLoader": StatefulDataLoader})
    assert taken == list(range(20))
