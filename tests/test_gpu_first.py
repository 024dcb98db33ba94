"""The script for the first run on a GPU: bash reads it, its settings are known, a small run on the CPU leaves all
figures."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.trainer.evaluation.h5_file import write_h5
from trainer.config_file import load_config

SCRIPT = Path(__file__).parents[1] / "examples" / "gpu_first.sh"
SMALL = {
    "DEVICE": "cpu", "SECONDS_EACH": "600", "STEPS_EACH": "6", "FEED_SECONDS": "0.1", "WORKERS": "1", "BATCH": "2",
    "GRIDS": "4", "CROP": "32", "STEPS_TIMED": "1",
    "FRAMES": "45", "SIDE": "32", "PYTHON": sys.executable, "WEIGHTS": "none",
    "OMP_NUM_THREADS": "1",
    "SETTINGS": "run.log_every=1 network.options.base_channels=4 compute.threads=1",
}  # fmt: skip
NVIDIA_SMI = "#!/bin/sh\nprintf '50, 2000\\n[N/A], 10\\n100, 3000\\n'\n"
"""Stand-in: use in percent, and memory in MiB."""
FILES = {
    *("machine.json", "feed.json", "firenet.jsonl", "firenet_resumed.jsonl", "e2vid.jsonl"),
    *("firenet_step.json", "e2vid_step.json", "firenet_scores.json", "e2vid_scores.json", "summary.json"),
}


@pytest.mark.parametrize("configuration", ["firenet-cpu", "e2vid"])
def test_settings_are_known(configuration: str) -> None:
    """Also those that only a run with a GPU uses. `bench step` adds precision, memory format and launch."""
    settings = re.findall(r"--set (?:'([a-z_.]+=[^']+)'|([a-z_.]+\.[a-z_]+=\w+))", SCRIPT.read_text("utf-8"))
    config = load_config(configuration, [quoted or plain for quoted, plain in settings])
    assert (config.stream.loader_workers, config.stream.spec["scene"]) == (1, "off")


def started(**places: str) -> subprocess.CompletedProcess[str]:
    """Start a small run, and return how it ended."""
    environment = os.environ | SMALL | places
    return subprocess.run(["bash", str(SCRIPT)], env=environment, capture_output=True, text=True, check=False)


def test_earlier_figures_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "summary.json").touch()
    done = started(OUT=str(tmp_path))
    assert (done.returncode, "give another folder, OUT=DIR" in done.stderr) == (2, True)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # it may compile kernels
def test_a_small_run_leaves_all_figures(tmp_path: Path) -> None:
    (tmp_path / "nvidia-smi").write_text(NVIDIA_SMI)
    (tmp_path / "nvidia-smi").chmod(0o755)
    out, path = tmp_path / "out", f"{tmp_path}:{os.environ['PATH']}"
    nothing = np.zeros(2)
    write_h5(tmp_path / "work/recordings/blind.h5", np.array([0.0, 1.0]), nothing, nothing, nothing, [])
    done = started(OUT=str(out), WORK=str(tmp_path / "work"), PATH=path)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert {file.name for file in out.iterdir()} == FILES
    summary = json.loads((out / "summary.json").read_text())
    assert {stage["status"] for stage in summary["stages"].values()} == {0}
    assert (summary["machine"]["device"], summary["feed"]["lost"]) == ("cpu", 0)
    assert (summary["resume"]["saved_at_step"], summary["resume"]["next_reading_step"]) == (3, 4)
    for name, last in (("firenet", 3), ("firenet_resumed", 6), ("e2vid", 6)):
        run = summary[name]
        assert (run["last_reading_step"], run["gpu_busy_share"], run["gpu_peak_memory_mib"]) == (last, 0.75, 3000)
        assert 0 <= run["loop_waited_share"] <= 1
    for name in ("firenet", "e2vid"):
        # The run took the settings of its fastest step.
        fastest = summary["step"][name]["settings"].split()
        config = load_config(str(tmp_path / "work" / "runs" / name / "config.yaml"))
        assert load_config(str(tmp_path / "work" / "runs" / name / "config.yaml"), fastest) == config
    # A recording without pictures is named, and the default ones are scored.
    assert len(re.findall(r"not scored: .*blind\.h5", done.stderr)) == done.stderr.count("not scored: ") == 2
    assert [scored["sequences"] for (scored,) in summary["scores"].values()] == [20, 20]
