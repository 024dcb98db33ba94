"""OpenCV is there for those who use it, and costs the others nothing."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2 as real
import pytest

from v2v_server import flow as methods
from v2v_server.system.compile_cache import cv2


def test_it_is_opencv() -> None:
    assert cv2.resize is real.resize
    assert cv2.ximgproc is real.ximgproc
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        cv2.nonsense  # type: ignore[attr-defined]  # noqa: B018


def test_presets_have_opencvs_numbers() -> None:
    assert methods.DIS_ULTRAFAST == real.DISOPTICAL_FLOW_PRESET_ULTRAFAST
    assert methods.DIS_FAST == real.DISOPTICAL_FLOW_PRESET_FAST


@pytest.mark.parametrize(
    ("code", "is_loaded"),
    [
        ("import v2v_server.worker.process", False),
        (
            "import numpy as np; from v2v_server.flow import choose; choose(*np.zeros((2, 32, 32), np.uint8))",
            True,
        ),
    ],
)
def test_a_worker_loads_it_with_its_first_use(code: str, is_loaded: bool) -> None:
    seen = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}; print('cv2' in sys.modules)"],
        capture_output=True, check=True, text=True,
    )  # fmt: skip
    assert seen.stdout.strip() == str(is_loaded)


def test_it_begins_with_the_number_of_threads_that_a_worker_states() -> None:
    code = "from v2v_server.system.compile_cache import cv2; print(cv2.getNumThreads())"
    environment = os.environ | {"OPENCV_FOR_THREADS_NUM": "1"}
    seen = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True, env=environment)
    assert seen.stdout.strip() == "1"
