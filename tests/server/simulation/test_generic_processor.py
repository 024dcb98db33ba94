"""A processor without any extension of its instruction set gives the same bytes, with kernels compiled for it."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

COMPILE_SECONDS = 1200
"""A kernel takes half a minute of processor time to compile, of which a busy machine gives a tenth."""
_ROOT = Path(__file__).parents[3]
PIXEL = "from tests.server.simulation.test_pixel import digest; print(digest('int8'), digest('float32'))"
EFFECTS = "from tests.server.simulation.test_effects import digest; print(digest('float32'))"
WORLDS = "from tests.server.worlds.test_render import digests; print(*digests().values())"
TIMES = """
import dataclasses, hashlib
import numpy as np
from tests.server.simulation.test_pixel import moving_frames
from tests.server.simulation.test_times import ALL, FPS
from v2v_server.simulation import simulate
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.kernels import fill
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.voxel import FINE_STEPS, Levels, Moments

grey = np.linspace(0, 255 * FINE_STEPS, 80).astype(np.uint16).reshape(2, 5, 8)
levels = Levels(Moments(np.array([0, 2]), np.array([0.25, 1 / 3])), grey)
digest = hashlib.sha256()
for effects in ({}, ALL):
    for precision in ("float32", "float64"):
        made = simulate(
            moving_frames(9, 5, 8, 3), threshold_pos=0.2, noise_sigma=0.1, bins=3, grids_per_frame=2, dtype="float32",
            seed=5, frames_per_second=FPS, precision=precision, **effects,
        )
        for array in fill(dataclasses.replace(made.given, levels=levels), made.real, dict.fromkeys(NAMES))[0].values():
            digest.update(array.tobytes())
        digest.update(made.to_events(1000.0).t.tobytes())
print(digest.hexdigest()[:32])
"""
MOTION = """
import hashlib
import numpy as np
from tests.oracles.rendered import rendered_scene
from tests.server.motion.test_clip import sub_steps
for name in ("coins", "parallax", "flicker"):
    for px in (2.0, 9.0):
        levels = sub_steps(rendered_scene(name, 72, 88, 30 * px).frames(30, 3))
        print(hashlib.sha256(levels.grey).hexdigest())
"""


def printed_on_a_generic_processor(code: str, tmp_path: Path) -> list[str]:
    """Return the words that a program prints there.

    All tests of a run share the kernels that they compile. One program runs at a time: numba's cache cannot take more.
    """
    run = tmp_path.parents[1] if "PYTEST_XDIST_WORKER" in os.environ else tmp_path.parent
    cache = run / "generic-kernels"
    cache.mkdir(exist_ok=True)
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", code]
    with (run / "generic-kernels.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return subprocess.run(
            command,
            env=os.environ | generic,
            cwd=_ROOT,
            capture_output=True,
            text=True,
            timeout=COMPILE_SECONDS,
            check=True,
        ).stdout.split()


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS + 60)
@pytest.mark.parametrize(
    "code", [PIXEL, EFFECTS, TIMES, MOTION, WORLDS], ids=["pixel", "effects", "times", "motion", "worlds"]
)
def test_any_processor_gives_the_same_bytes(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    exec(code, {})
    here = capsys.readouterr().out.split()
    monkeypatch.setenv("OPENCV_CPU_DISABLE", "AVX2,FMA3")
    assert here == printed_on_a_generic_processor(code, tmp_path)
