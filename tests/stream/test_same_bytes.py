"""The promise: the same (spec, seed, epoch, index) gives the same bytes, whichever process makes the sample."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stream.conftest import Corpus, digest, epoch_of, made_here, server_workers
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_tools.simulate import main as simulate


@pytest.fixture(scope="module")
def reference(clips: Path) -> list[str]:
    """Digests of the batches of two epochs, made without a server."""
    return [digest(batch) for batch in made_here(clips, 0, 1)]


@pytest.mark.parametrize(("shared", "compress"), [(True, False), (False, False), (False, True), (True, True)])
def test_workers_and_the_way_samples_travel_change_nothing(
    server: LocalServer, reference: list[str], shared: bool, compress: bool
) -> None:
    got = [
        digest(batch)
        for epoch in (0, 1)
        for batch in epoch_of(server.address, epoch=epoch, shared_memory=shared, compress=compress)
    ]
    assert got == reference
    assert len(reference) == len(set(reference))


def test_a_killed_worker_changes_nothing(corpus: Corpus) -> None:
    of: dict[str, Any] = {"recipe": corpus.recipe, "seed": 3, "batch_size": 3}
    with LocalServer(corpus.folder, workers=2, flags=corpus.flags) as server:
        workers = server_workers(server.pid)
        assert len(workers) == 2
        got = []
        for number, batch in enumerate(V2VStreamDataset(server.address, **of)):
            got.append(digest(batch))
            if number < 2:
                os.kill(workers[number].pid, signal.SIGKILL)
        got += [digest(batch) for batch in epoch_of(server.address, epoch=1, recipe=corpus.recipe)]
    here = made_here(corpus.folder, 0, 1, recipe=corpus.recipe, kind=corpus.kind)
    assert got == [digest(batch) for batch in here]


def test_v2v_simulate_makes_the_same_sample(clips: Path, server: LocalServer, tmp_path: Path) -> None:
    recipe = tmp_path / "small.yaml"
    recipe.write_text("preset: paper\nvoxels_per_clip: 4\ncrop_height_px: 32\n", encoding="utf-8")
    command = [str(clips), "--recipe", str(recipe), "--set", "crop_width_px=40", "--seed", "3", "--index", "7"]
    command += ["--out", str(tmp_path / "sample.npz"), "--picture", str(tmp_path / "sample.png")]
    assert simulate(command) == 0
    batch = epoch_of(server.address)[2]
    with np.load(tmp_path / "sample.npz") as sample:
        np.testing.assert_array_equal(sample["voxels"], batch.voxels[1].numpy())
        np.testing.assert_array_equal(sample["frames"], batch.frames[1].numpy())
        provenance = json.loads(str(sample["provenance"]))
    assert provenance == json.loads(json.dumps(batch.provenance[1].to_dict()))
    assert provenance["id"]["index"] == 7 == batch.indices[1]
    assert (tmp_path / "sample.png").stat().st_size > 1000
