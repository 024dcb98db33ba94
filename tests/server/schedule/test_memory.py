"""The estimate of the memory that a lease takes, against what a process that makes its sample takes at its peak."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.clips import panned_luma, write_clip

pytestmark = [
    pytest.mark.slow, pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]  # fmt: skip
_PROGRAM = """
import gc, json, sys
from contextlib import closing
from v2v_protocol.sample import DEFAULT_ARRAYS, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.lease_memory import lease_bytes
from v2v_server.worker.warm_up import warm_up_in_turn
from v2v_tools.remake import Remaker

if __name__ == "__main__":
    warm_up_in_turn()
    with closing(open_catalogue(sys.argv[1], cache_dir=sys.argv[1] + "/cache", processes=0)) as catalogue:
        spec = StreamSpec.from_dict(json.loads(sys.argv[2]))
        remaker = Remaker(catalogue, spec)
        gc.collect()
        open("/proc/self/clear_refs", "w").write("5")
        video = remaker.made(0, 0, 0) and catalogue.videos[0]
        status = dict(line.split(":", 1) for line in open("/proc/self/status"))
        arrays = layout_bytes(array_layout(spec.recipe, spec.voxel_dtype, DEFAULT_ARRAYS))
        print(lease_bytes(video, catalogue.rows, spec, arrays), 1024 * int(status["VmHWM"].split()[0]))
"""


@pytest.mark.parametrize(
    ("spec", "most"),
    [
        (
            {"recipe": {"voxels_per_clip": 20, "resize_scale": [0.5, 0.5], "crop_height_px": 64, "crop_width_px": 64}},
            1.7,
        ),
        ({"recipe": {"voxels_per_clip": 4, "crop_height_px": 1000, "crop_width_px": 1800}}, 1.7),
        # How many sub-steps there are depends on the motion, which the estimate does not know.
        ({"recipe": {"voxels_per_clip": 8, "crop_height_px": 300, "crop_width_px": 600}, "substep_px": 0.5}, 2.5),
    ],
    ids=["resized", "large crop", "sub-steps"],
)
def test_a_lease_takes_at_most_what_is_estimated_and_not_much_less(
    tmp_path: Path, spec: dict[str, Any], most: float
) -> None:
    write_clip(tmp_path / "v.mp4", panned_luma(102, 1080, 1920))
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(tmp_path), json.dumps(spec)], capture_output=True, text=True, check=True
    )
    estimate, peak = map(int, done.stdout.split())
    assert peak < estimate < most * peak
