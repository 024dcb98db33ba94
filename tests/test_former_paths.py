"""Documented names of earlier releases can be imported from where they were."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest


@pytest.mark.parametrize(
    ("former", "now", "name"),
    [
        ("v2v_client.session.liveness", "v2v_client", "Patience"),
    ],
)
def test_the_former_path_gives_the_same(former: str, now: str, name: str) -> None:
    """However it is imported, and by a process that has imported nothing else: pickles name it."""
    assert getattr(import_module(former), name) is getattr(import_module(now), name)
    program = f"import {former} as module\nfrom {former} import {name}\nassert module.{name} is {name}"
    subprocess.run([sys.executable, "-c", program], check=True)
