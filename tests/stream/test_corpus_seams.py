"""An array from a sidecar, a kind of video and a kind of source, added to the packages as `docs/extending.md` says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from tests.test_seams import add

ROOT = Path(__file__).parents[2]


def shown_below(heading: str) -> list[str]:
    """Return the code that the page shows from a heading on."""
    page = (ROOT / "docs/extending.md").read_text("utf-8")
    return re.findall(r"```python\n(.*?)```", page.partition(f"{heading}\n")[2], re.DOTALL)


FORM, BUILDER = shown_below("### An array from a file beside the video")[:2]
"""The line and the file that the page shows for depth."""
DEPTH_LINES = (
    ("v2v_protocol/sample.py", '    "flow_valid": ArrayForm(', FORM),
    ("v2v_server/worker/arrays/__init__.py", '    "flow",', '    "depth",\n'),
)  # fmt: skip

SOURCE = '''
"""A folder by the name toy:PATH, whose videos have a prefix."""

from contextlib import nullcontext
from pathlib import Path

from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.source import VideoSource


class Toy(VideoSource):
    def __init__(self, name):
        super().__init__(name)
        self._below = Folder(Path(name.removeprefix("toy:")))

    def videos(self, refused, left_out):
        for id in self._below.videos(refused, left_out):
            yield f"toys/{id}"

    def states(self, ids):
        return self._below.states([id.removeprefix("toys/") for id in ids])

    def state(self, id):
        return self._below.state(id.removeprefix("toys/"))

    def open_local(self, id, fingerprint):
        return self._below.open_local(id.removeprefix("toys/"), fingerprint)

    def verify(self, id, fingerprint, state):
        self._below.verify(id.removeprefix("toys/"), fingerprint, state)


def open_source(name, options):
    return Toy(name) if name.startswith("toy:") else None
'''
SOURCE_LINE = ("v2v_server/corpus/sources/source.py", '"copies", "prepared"', '"toy", ')

KIND, *_ = shown_below("## A kind of video")
KIND_LINE = ("v2v_server/kinds/registry.py", '    "photographs",', '    "stripes",\n')

OVERLAY = '''
"""Import a module from this folder if it is there. All others, the kernels too, are those of the packages."""

import sys
from importlib.util import spec_from_file_location
from pathlib import Path


class Overlay:
    @staticmethod
    def find_spec(name, path=None, target=None):
        place = Path(__file__).parent.joinpath(*name.split("."))
        if (place / "__init__.py").is_file():
            others = [f"{below}/{place.name}" for below in path]
            return spec_from_file_location(name, place / "__init__.py", submodule_search_locations=others)
        file = place.with_suffix(".py")
        return spec_from_file_location(name, file) if file.is_file() else None


sys.meta_path.insert(0, Overlay)
'''

USE_SIDECAR = """
import json, sys
from pathlib import Path
import numpy as np
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import SampleUnavailable, StateMismatch
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_tools.remake import remake

folder, cache = Path(sys.argv[1]), sys.argv[2]
small = dict(voxels_per_clip=4, bins=2, crop_height_px=16, crop_width_px=24, pause_probability=0.0)
flags = ["--cache-dir", cache, *(f"--set={name}={value}" for name, value in small.items())]
arrays = ("frames", "depth")

def stream(server, asked=arrays, labels="optional", **more):
    return V2VStreamDataset(server.address, batch_size=2, arrays=asked, seed=1, labels=labels, **more)

def depths(batches):
    made = {}
    for batch in batches:
        depth = np.asarray(batch["depth"])
        assert depth.shape == (2, 4, 1, 16, 24) and (depth == depth[..., :1, :1]).all()
        made.update(zip(batch.indices, depth[:, :, 0, 0, 0].tolist()))
    return made

def write(step):
    for frame in range(30):
        np.save(folder / f"a.depth/{frame:06}.npy", np.full((16, 24), step * frame, np.float32))

write(10.0)
with LocalServer(folder, workers=1, flags=flags) as server:
    batches = list(stream(server))
    made = depths(batches)
    assert depths(stream(server, shared_memory=False)) == made, "in the message as in shared memory"
    state, plain = batches[0].resume_state, next(iter(stream(server, ("frames",)))).resume_state
    resumed = stream(server)
    resumed.load_state_dict(state)
    rest = depths(resumed)
    assert rest == {index: made[index] for index in rest} and len(rest) == len(made) - 2
    for batch in batches:
        for row, origin in zip(np.asarray(batch["depth"][:, :, 0, 0, 0]), batch.provenance):
            expected = [-1.0] * 4
            if origin.video == "a.mp4":
                expected = [10.0 * (origin.start_frame + 2 * step) for step in range(1, 5)]
                assert list(origin.sidecars) == [".depth/"]
            assert row.tolist() == expected, (origin, row)
assert state["sidecars"] and "sidecars" not in plain

with_depth = open_catalogue(folder, cache_dir=cache, processes=0)
for index, expected in made.items():
    sample = remake(with_depth, StreamSpec.from_dict(state["spec"]), seed=1, epoch=0, index=index, arrays=arrays)
    assert sample.arrays["depth"][:, 0, 0, 0].tolist() == expected

# A damaged sidecar leaves its samples without labels, or is an error; an array without labels does not notice.
(folder / "a.depth/000002.npy").write_text("no array")
with LocalServer(folder, workers=1, flags=flags) as server:
    origins = [each for batch in stream(server) for each in batch.provenance]
    assert any("a.mp4: its sidecar .depth/: " in each.unlabelled.get("depth", "") for each in origins)
    assert all(each.unlabelled for each in origins if each.video == "b.mp4")
    try:
        list(stream(server, labels="required"))
        raise AssertionError("no error")
    except SampleUnavailable as error:
        assert "its sidecar .depth/: " in str(error) and 'labels="optional"' in str(error), error
    resumed = stream(server)
    resumed.load_state_dict(state)
    try:
        list(resumed)
        raise AssertionError("no error")
    except StateMismatch as error:
        assert str(error).startswith("sidecars: "), error
    resumed = stream(server, ("frames",))
    resumed.load_state_dict(plain)
    frames = list(resumed)
    assert len(frames) == len(batches) - 1
    # Changed under a running server, here and so everywhere: the consumer is told, and no video is refused.
    write(5.0)
    try:
        list(stream(server))
        raise AssertionError("no error")
    except SampleUnavailable as error:
        assert "a.mp4: its sidecar .depth/: changed since it was catalogued" in str(error), error
    assert not any(each.refusals for batch in stream(server, ("frames",)) for each in batch.provenance)
again = open_catalogue(folder, cache_dir=cache, processes=0)
assert again.digest == with_depth.digest
assert again.sidecars[".depth/"].digest != with_depth.sidecars[".depth/"].digest
again.close()
with_depth.close()
"""

USE_SOURCE = """
import sys
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer

small = dict(voxels_per_clip=4, bins=2, crop_height_px=16, crop_width_px=24)
flags = ["--cache-dir", sys.argv[2], *(f"--set={name}={value}" for name, value in small.items())]
with LocalServer(f"toy:{sys.argv[1]}", workers=1, flags=flags) as server:
    batches = list(V2VStreamDataset(server.address, batch_size=2, seed=1))
assert {each.video for batch in batches for each in batch.provenance} == {"toys/a.mp4", "toys/b.mp4"}
"""


USE_KIND = """
import json, sys
from contextlib import closing
from pathlib import Path
import numpy as np
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.commands.prepare import main as prepare
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.registry import kind_from
from v2v_server.kinds.stripes import StripesKind
from v2v_tools.doctor.command import main as doctor
from v2v_tools.preview import main as preview
from v2v_tools.remake import remake
from v2v_tools.simulate import main as simulate

folder, cache = Path(sys.argv[1]).with_name("stripes"), sys.argv[2]
folder.mkdir()
for name in "ab":
    (folder / f"{name}.stripes").write_text("60 48 64")
fields = dict(voxels_per_clip=4, crop_height_px=32, crop_width_px=32)
small = [f"--set={name}={value}" for name, value in fields.items()]
kind = ["--videos-kind", "stripes", "--stripe-hz", "50"]
here = ["--cache-dir", cache, *kind]

def opened(path=folder, **flags):
    return closing(open_catalogue(path, cache_dir=cache, processes=0, kind=StripesKind(**flags)))

# The flag has an effect on what is indexed already.
with opened() as first, opened(stripe_hz=50.0) as second:
    assert set(first.videos.frames_per_second) == {25.0} and set(second.videos.frames_per_second) == {50.0}
    assert first.digest != second.digest and second.kind.name == "stripes"
    digest = second.digest

with LocalServer(folder, workers=1, flags=[*here, *small]) as server:
    batches = list(V2VStreamDataset(server.address, batch_size=2, arrays=("voxels", "frames"), seed=1))
state = batches[0].resume_state
assert state["catalogue_digest"] == digest, state
with opened(stripe_hz=50.0) as catalogue:
    for batch in batches:
        for row, origin in enumerate(batch.provenance):
            made = remake(catalogue, StreamSpec.from_dict(state["spec"]), seed=1, epoch=0, index=origin.id.index)
            assert np.array_equal(made.arrays["voxels"], np.asarray(batch["voxels"][row]))
            assert origin.decoder == "stripes" and made.arrays["voxels"].any()

out = folder.with_name("prepared")
assert prepare([str(folder), str(out), "--workers", "1", *here]) == 0
with closing(open_catalogue(out, cache_dir=cache, processes=0)) as prepared:  # a store needs no flag
    assert (prepared.digest, prepared.kind.name) == (digest, "stripes")
    made = remake(prepared, StreamSpec.from_dict(state["spec"]), seed=1, epoch=0, index=origin.id.index)
    assert np.array_equal(made.arrays["voxels"], np.asarray(batch["voxels"][row]))

recipe = folder.with_name("small.yaml")
recipe.write_text("\\n".join(f"{name}: {value}" for name, value in fields.items()))
assert doctor(["--videos", str(folder), "--recipe", str(recipe), "--port", "5999", *here]) == 0
assert preview([str(folder), "--out", str(folder.with_name("sheet.png")), "--seeds", "1", *here, *small]) == 0
assert simulate([str(folder), "--out", str(folder.with_name("one.npz")), "--index", "0", *here, *small]) == 0
try:
    kind_from({"videos_kind": "videos", "stripe_hz": 50.0})
    raise AssertionError("no error")
except UsageError as error:
    assert str(error).startswith("--stripe-hz 50.0 has no effect without --videos-kind stripes"), error
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files with these additions, which an import prefers to those of the packages, and two clips."""
    tmp_path = tmp_path_factory.mktemp("tree")
    for name in ("v2v_server/worker/arrays", "v2v_server/corpus/sources", "v2v_server/kinds", "v2v_protocol"):
        (tmp_path / name).mkdir(parents=True)
    for name, *_ in (*DEPTH_LINES, SOURCE_LINE, KIND_LINE):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "sitecustomize.py").write_text(OVERLAY)
    (tmp_path / "clips").mkdir()
    for name in ("a.mp4", "b.mp4"):
        write_clip(tmp_path / "clips" / name, panned_luma(30, 16, 24), gop=12)
    (tmp_path / "v2v_server/worker/arrays/depth.py").write_text(BUILDER)
    (tmp_path / "v2v_server/corpus/sources/toy.py").write_text(SOURCE)
    (tmp_path / "v2v_server/kinds/stripes.py").write_text(KIND)
    add(tmp_path, (*DEPTH_LINES, SOURCE_LINE, KIND_LINE))
    return tmp_path


def run(tree: Path, program: str) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-c", program, str(tree / "clips"), str(tree / "cache")], env=environment, cwd=tree,
        capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_an_array_with_a_sidecar_is_a_file_and_two_lines(tree: Path) -> None:
    (tree / "clips/a.depth").mkdir()
    run(tree, USE_SIDECAR)


@pytest.mark.slow
def test_a_kind_of_source_is_a_file_and_a_line(tree: Path) -> None:
    run(tree, USE_SOURCE)


@pytest.mark.slow
def test_a_kind_of_video_is_a_file_and_a_name(tree: Path) -> None:
    run(tree, USE_KIND)
