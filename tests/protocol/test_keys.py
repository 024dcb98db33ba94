"""A key that is handed on without a file of its own."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from v2v_protocol.keys import KEY_LETTERS, PeerKey, nameless_key, read_key

KEY = PeerKey("worker", "ray-1", "s" * KEY_LETTERS, "p" * KEY_LETTERS, "x" * KEY_LETTERS)


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_nameless_key_reaches_a_child(in_memory: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not in_memory:
        monkeypatch.delattr(os, "memfd_create", raising=False)
    program = "import sys; from pathlib import Path; from v2v_protocol.keys import read_key\n"
    program += "print(read_key(Path(sys.argv[1])).secret)"
    with nameless_key(KEY) as file:
        name = f"/dev/fd/{file.fileno()}"
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600
        assert [read_key(Path(name)) for _ in range(2)] == [KEY, KEY]
        told = subprocess.run(
            [sys.executable, "-c", program, name], pass_fds=[file.fileno()], capture_output=True, text=True, check=True
        )
    assert told.stdout.strip() == KEY.secret
    assert KEY.secret not in repr(KEY)
