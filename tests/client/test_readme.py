"""The training loop of the README, as it stands there but for its server, its size and its device."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.client.fake_server import FakeServer
from tests.tools.snippets import snippets
from v2v_client import V2VStreamDataset

SMALLER = {
    'batch_size=12, recipe="paper"': "batch_size=2",
    "range(dataset.epoch, 80)": "range(dataset.epoch, 2)",
    '"cuda"': '"cpu"',
}


class Killed(Exception):
    """The program ends here."""


def test_the_training_loop_resumes_where_it_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (loop,) = (snippet for snippet in snippets("README.md") if "resume_state" in snippet)
    with FakeServer(sequences=6) as server:
        for there, here in {'"tcp://127.0.0.1:5555"': f'"{server.address}"', **SMALLER}.items():
            assert there in loop
            loop = loop.replace(there, here)

        def trained(batches: int) -> list[tuple[int, ...]]:
            seen: list[tuple[int, ...]] = []

            def loss_of(events: torch.Tensor, frames: torch.Tensor) -> None:
                batch = names["batch"]
                if len(seen) == batches:
                    raise Killed
                assert events.shape[:2] == frames.shape[:2]
                seen.append((batch.epoch, *batch.indices))

            names: dict[str, Any] = {"network": torch.nn.Identity(), "loss_of": loss_of}
            try:
                exec(loop, {"os": os, "torch": torch, "V2VStreamDataset": V2VStreamDataset}, names)
            except Killed:
                names.clear()
            return seen

        whole = trained(100)
        os.remove("last.pt")
        assert len(whole) == len(set(whole)) == 6
        assert trained(4) == whole[:4]
        assert trained(100) == whole[3:]
