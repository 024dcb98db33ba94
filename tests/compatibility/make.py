"""Write fixtures of the present release: the files that users keep, and the bytes that they must go on to give.

    python -m tests.compatibility.make

    numerics-N   a folder of videos with its index, store and cache; a recipe, a state, a checkpoint
    planes-N-A   the same of videos with colour, deep light, motion, scenes and labels
    recordings-M-N   a folder of prepared recordings

A fixture is made once for each ``NUMERICS_VERSION`` N, one of planes for each ``ANALYSIS_VERSION`` A, and one of
recordings for each form M of their file (the last byte of ``FILE_MAGIC``), with the release that first has it, and is
never rewritten.
``test_compatibility.py`` reads all of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
import yaml

from tests.clips import panned_luma, write_clip
from tests.digests.clips import boxes_text, panning, write_coloured, write_deep, write_recordings, zooming
from tests.digests.rows import PORTABLE, SIZE, Row, digest, made, samples_of
from tests.digests.rows import ROWS as PLANE_ROWS
from trainer.run.checkpoint import load_checkpoint
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol import NUMERICS_VERSION, __version__
from v2v_recordings.block_file import FILE_MAGIC
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION
from v2v_server.kinds.registry import KINDS
from v2v_server.prepare import prepare
from v2v_server.store.cache import Cache, make_cache
from v2v_server.video.rows import Rows

FOLDER = Path(__file__).parent / f"numerics-{NUMERICS_VERSION}"
PLANES = Path(__file__).parent / f"planes-{NUMERICS_VERSION}-{ANALYSIS_VERSION}"
RECORDINGS = Path(__file__).parent / f"recordings-{FILE_MAGIC[-1:].decode()}-{NUMERICS_VERSION}"
RECIPE_FIELDS = {
    "preset": "paper", "voxels_per_clip": 2, "crop_height_px": 24, "crop_width_px": 24, "noise_sigma": [0.0, 0.05],
}  # fmt: skip
ROWS = "top:0.9"
SEED = 7
CUT = 1
"""Batches that the trainer of the fixture took before it saved its state."""


def main() -> int:
    """Write the fixtures of this release that are missing, and refuse to replace one."""
    makers = (FOLDER, _make), (PLANES, _make_planes), (RECORDINGS, _make_recordings)
    missing = [(folder, make) for folder, make in makers if not folder.exists()]
    if not missing:
        print(f"{FOLDER}, {PLANES.name} and {RECORDINGS.name} exist: a fixture is never rewritten", file=sys.stderr)
        return 2
    for folder, make in missing:
        with tempfile.TemporaryDirectory() as scratch:
            shutil.copytree(make(Path(scratch)), folder)
    return 0


def stream(videos: Path, *flags: str, recipe: Path, state: Mapping[str, Any] | None = None) -> list[Batch]:
    """Return the batches of one epoch of a folder of videos, from the start or from a saved state on."""
    fields = yaml.safe_load(recipe.read_text())
    with LocalServer(videos, workers=1, flags=["--recipe", str(recipe), *flags]) as server:
        dataset = V2VStreamDataset(server.address, batch_size=2, recipe=fields, seed=SEED)
        if state is not None:
            dataset.load_state_dict(state)
        return list(dataset)


def sample_digests(batch: Batch) -> list[str]:
    """Return the SHA-256 of the voxels and frames of each sample."""
    arrays = zip(batch.voxels.numpy(), batch.frames.numpy(), strict=True)
    return [hashlib.sha256(voxels.tobytes() + frames.tobytes()).hexdigest() for voxels, frames in arrays]


def tensors_digest(model: Mapping[str, torch.Tensor]) -> str:
    """Return the SHA-256 of the names and values of a state dict."""
    sha = hashlib.sha256()
    for name in sorted(model):
        sha.update(name.encode() + model[name].numpy().tobytes())
    return sha.hexdigest()


def train(videos: Path, out: Path, *, steps: int, resume: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Train the smallest network up to a step, in a process of its own."""
    values = {
        **{f"stream.recipe.{name}": value for name, value in RECIPE_FIELDS.items() if name != "preset"},
        "run.steps": steps, "run.seconds": 0, "run.judge_every": 0, "run.preview_every": 0, "run.save_every": 1,
        "network.options.base_channels": 2,
    }  # fmt: skip
    flags = [flag for name, value in values.items() for flag in ("--set", f"{name}={json.dumps(value)}")]
    flags += ["--out", str(out)] if resume is None else ["--resume", str(resume), "--out", str(out)]
    command = [sys.executable, "-m", "trainer.train", "tiny-cpu", "--videos", str(videos), *flags]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _make(scratch: Path) -> Path:
    os.environ["V2V_CACHE_DIR"] = str(scratch / "user-cache")
    fixture = scratch / "fixture"
    videos = fixture / "videos"
    videos.mkdir(parents=True)
    write_clip(videos / "a.mp4", panned_luma(50, 40, 48), gop=12, b_frames=2)
    write_clip(videos / "b.webm", panned_luma(38, 32, 40, step=(2, 1)), codec="libvpx-vp9")
    (fixture / "recipe.yaml").write_text(yaml.safe_dump(RECIPE_FIELDS))
    batches = stream(videos, "--cache", str(fixture / "cache"), "--rows", ROWS, recipe=fixture / "recipe.yaml")
    state = batches[CUT - 1].resume_state
    prepare = [sys.executable, "-m", "v2v_server.commands.prepare", str(videos), str(fixture / "store"), "--rows", ROWS]
    subprocess.run(prepare, check=True)
    with closing(open_catalogue(videos, rows=Rows.parse(ROWS))) as catalogue:
        shutil.copy(index_path(catalogue.folder, None), fixture / "index.sqlite3")
        expected = {
            "release": __version__,
            "numerics_version": NUMERICS_VERSION,
            "spec_digest": state["spec_digest"],
            "catalogue_digest": catalogue.digest,
            "samples": [digest for batch in batches for digest in sample_digests(batch)],
        }
    (fixture / "state.json").write_text(json.dumps(state, indent=1, sort_keys=True))
    done = train(videos, scratch / "run", steps=3)
    assert done.returncode == 0, done.stderr
    shutil.copy(scratch / "run" / "last.pt", fixture / "last.pt")
    expected["model"] = tensors_digest(load_checkpoint(fixture / "last.pt").model)
    (fixture / "expected.json").write_text(json.dumps(expected, indent=1))
    return fixture


STREAMS: Mapping[str, Row] = {
    "planes": Row(
        {"threshold": (0.1, 0.2)}, ("voxels", "frames", "frames_rgb", "boxes"),
        {"substep_px": 0.5, "scene": "auto", "moving_share": 1.0, "max_sequences_per_video": 2},
    ),
    "deep": Row({"light": "declared"}, ("voxels", "frames_u16"), {"max_sequences_per_video": 2}),
}  # fmt: skip
"""What the fixture of planes is read with."""
STREAM_FLAGS = ("--scene=auto", f"--rows={PLANE_ROWS}", *(f"--set={name}={value}" for name, value in SIZE.items()))


def plane_digests(catalogue: Catalogue, cache: Cache | None = None) -> dict[str, dict[str, str]]:
    """Return the digest of each array of each of STREAMS."""
    return {
        name: {array: digest(values) for array, values in made(samples_of(catalogue, row, cache))[0].items()}
        for name, row in STREAMS.items()
    }


def labelled(address: str, state: Mapping[str, Any] | None = None) -> list[Batch]:
    """Return the samples of the first of STREAMS, from the start or from a saved state on."""
    row = STREAMS["planes"]
    spec: dict[str, Any] = {**row.spec, "recipe": row.stream.recipe}
    dataset = V2VStreamDataset(address, 1, row.arrays, labels="optional", seed=row.seed, **spec)
    if state is not None:
        dataset.load_state_dict(state)
    return list(dataset)


def _make_planes(scratch: Path) -> Path:
    os.environ["V2V_CACHE_DIR"] = str(scratch / "user-cache")
    fixture = scratch / "fixture"
    videos = fixture / "videos"
    videos.mkdir(parents=True)
    luma, chroma = zooming(20)
    write_coloured(videos / "a.mkv", luma[:, :40, :56], chroma[:, :, :20, :28])
    write_deep(videos / "b.mkv", panning(20)[:, :40, :56])
    (videos / "a.boxes.json").write_text(boxes_text(20))
    make_cache(fixture / "cache")
    with closing(open_catalogue(videos, rows=PLANE_ROWS, scene=True, processes=0)) as catalogue:
        cache = Cache(fixture / "cache", 1 << 30, least_free_bytes=0)
        streams = plane_digests(catalogue, cache)
        planes = ("motion", "chroma")
        prepare(catalogue, fixture / "store", processes=0, scene=True, planes=planes)
        shutil.copy(index_path(catalogue.folder, None), fixture / "index.sqlite3")
        expected = {
            "release": __version__,
            "numerics_version": NUMERICS_VERSION,
            "analysis_version": ANALYSIS_VERSION,
            "catalogue_digest": catalogue.digest,
            "scene_digest": catalogue.scene_digest,
            "streams": streams,
        }
    with LocalServer(videos, workers=1, flags=STREAM_FLAGS) as server:
        batches = labelled(server.address)
    (fixture / "state.json").write_text(json.dumps(batches[0].resume_state, indent=1, sort_keys=True))
    expected["labelled"] = [digest(batch.arrays[name].numpy()) for batch in batches for name in batch.arrays]
    (fixture / "expected.json").write_text(json.dumps(expected, indent=1))
    return fixture


def recording_digests(folder: Path, cache_dir: Path) -> dict[str, Any]:
    """Return the digest of a folder of prepared recordings, and of each array of each row of the table of digests."""
    kind = KINDS["recordings"]
    with closing(open_catalogue(folder, cache_dir=cache_dir, kind=kind, processes=0)) as catalogue:
        rows = {name: row for name, row in PORTABLE.items() if row.kind == kind.name}
        streams = {
            name: {array: digest(values) for array, values in made(samples_of(catalogue, row))[0].items()}
            for name, row in rows.items()
        }
        return {"catalogue_digest": catalogue.digest, "streams": streams}


def _make_recordings(scratch: Path) -> Path:
    fixture = scratch / "fixture"
    fixture.mkdir()
    found = recording_digests(write_recordings(fixture / "recordings"), scratch)
    expected = {"release": __version__, "numerics_version": NUMERICS_VERSION, **found}
    (fixture / "expected.json").write_text(json.dumps(expected, indent=1))
    return fixture


if __name__ == "__main__":
    sys.exit(main())
