"""A stream from archives: a consumer cannot tell it from that of the folder, also when it goes on in mid-epoch."""

from __future__ import annotations

import os
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from tests.packed import packed_forms
from tests.stream.conftest import SMALL, SMALL_FLAGS, epoch_of
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer

pytestmark = pytest.mark.slow


def content(batch: Batch) -> tuple[Any, ...]:
    """All of a batch but from where it was read, which depends on when the cache was written."""
    names = [(each.video, each.start_frame, each.fingerprint) for each in batch.provenance]
    return batch.indices, names, batch.voxels.numpy().tobytes(), batch.frames.numpy().tobytes()


def test_folder_tar_and_zip_are_one_stream(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "index"))
    shutil.copytree(clips, tmp_path / "folder" / "0")
    reference, taken, state = list[Any](), 0, None
    for form, folder in packed_forms(tmp_path / "folder", tmp_path).items():
        flags = (*SMALL_FLAGS, "--cache", str(tmp_path / f"cache of {form}"))
        with LocalServer(folder, workers=2, flags=flags) as server:
            for _ in range(2):  # decoded, and from the cache
                found = [content(batch) for batch in epoch_of(server.address)]
                reference = reference or found
                assert found == reference, form
            stream = V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3)
            if state is not None:
                stream.load_state_dict(state)
            said = list(islice(stream, 2))
            assert list(map(content, said)) == reference[taken : taken + 2], form
            taken, state = taken + 2, said[-1].resume_state
            assert server._errors is not None
            assert "passed over" not in os.pread(server._errors.fileno(), 1 << 20, 0).decode(errors="replace")
