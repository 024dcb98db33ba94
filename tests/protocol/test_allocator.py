import ctypes
import pickle
import resource
import subprocess
import sys

import numpy as np
import pytest

from v2v_protocol.arena import keep_freed_memory

glibc_only = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="a setting of glibc")

BLOCK_BYTES = 64 << 20
"""Above the largest block that glibc ever keeps unasked."""


def page_faults_of_fresh_blocks(count: int) -> int:
    """Page faults of filling so many blocks, one after the other, once the first is there."""
    np.ones(BLOCK_BYTES, np.uint8)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        np.ones(BLOCK_BYTES, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@glibc_only
def test_kept_memory_is_used_again_without_page_faults():
    # It is a setting of a whole process, so it is tried in another one.
    script = (
        "from tests.protocol.test_allocator import page_faults_of_fresh_blocks as faults\n"
        "from v2v_protocol.arena import keep_freed_memory\n"
        "before = faults(4)\n"
        "assert keep_freed_memory()\n"
        "print(before, faults(4))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert after < before / 4


def test_loader_workers_can_be_given_it_however_they_are_started(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    worker_init_fn = pickle.loads(pickle.dumps(keep_freed_memory))
    assert not worker_init_fn(1)
