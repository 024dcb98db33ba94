"""Define fixtures for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

# Hypothesis fails an example that takes longer than 200 ms: a timing assertion, which a busy machine breaks.
settings.register_profile("v2v", deadline=None, print_blob=True)
settings.register_profile("ci", parent=settings.get_profile("v2v"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "v2v")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep catalogue indexes and quarantine files of the tests out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("V2V_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield
