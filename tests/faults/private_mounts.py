"""Commands that see other file systems than this process does, in a mount namespace of their own (Linux)."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

import pytest

ABSENT_SHM = """
new=$(mktemp -d) && mount -t tmpfs tmpfs "$new"
for node in null zero full random urandom tty; do : > "$new/$node" && mount --bind "/dev/$node" "$new/$node"; done
ln -s /proc/self/fd "$new/fd" && mount --rbind "$new" /dev && mount -o remount,bind,ro /dev && umount -l "$new"
rmdir "$new"
"""
"""A /dev without /dev/shm."""

READ_ONLY_SHM = "mount -t tmpfs -o ro tmpfs /dev/shm"

FULL_SHM = "mount -t tmpfs -o size=4k tmpfs /dev/shm && head -c 4096 /dev/zero > /dev/shm/filler"


def mounted(setup: str, command: Sequence[str]) -> list[str]:
    """``command`` as it runs after the shell lines ``setup``, whose mounts no other process sees.

    Skips the test where the system does not permit that.
    """
    if not sys.platform.startswith("linux"):
        pytest.skip("mount namespaces are Linux's")
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    unshare = ["unshare", *user, "--mount", "sh", "-e", "-c"]
    try:
        tried = subprocess.run([*unshare, "mount -t tmpfs tmpfs /mnt"], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no `unshare` here")
    if tried.returncode:
        pytest.skip(f"mounting in a namespace of one's own is not permitted here: {tried.stderr.strip()}")
    return [*unshare, f'{setup}\nexec "$@"', "sh", *command]
