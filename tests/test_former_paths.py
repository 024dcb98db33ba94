"""Documented names of earlier releases can be imported from where they were."""

from __future__ import annotations

from importlib import import_module

import pytest


@pytest.mark.parametrize(
    ("former", "now", "name"),
    [
        ("v2v_client.session.liveness", "v2v_client", "Patience"),
    ],
)
def test_the_former_path_gives_the_same(former: str, now: str, name: str) -> None:
    assert getattr(import_module(former), name) is getattr(import_module(now), name)
