"""Peers, and a publisher of their status from the beginning."""

from __future__ import annotations

import pytest

from tests.server.peers import Peers, peers
from tests.server.status.services import Published, published


@pytest.fixture
def at() -> Peers:
    return peers()


@pytest.fixture
def service(at: Peers) -> Published:
    return published(at)
