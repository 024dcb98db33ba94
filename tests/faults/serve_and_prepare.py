"""A server with cold caches, a stream from it, and a prepared folder; run where something is missing.

    python -m tests.faults.serve_and_prepare CLIPS FOLDER

Prints JSON: "lock" (why ``multiprocessing`` can make no lock, or null), "epoch" (digests of the batches), "prepared"
(exit status of ``v2v-prepare``), "said" (by the server).
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

from tests.stream.conftest import SMALL_FLAGS, digest, epoch_of
from v2v_client.local_server import LocalServer


def main(clips: Path, folder: Path) -> None:
    """Does all of it."""
    os.environ["V2V_CACHE_DIR"] = str(folder / "cache")
    lock = None
    try:
        multiprocessing.get_context("spawn").Lock()
    except OSError as error:
        lock = str(error)
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as server:
        epoch = [digest(batch) for batch in epoch_of(server.address)]
        said = server.last_lines()
    prepare = [sys.executable, "-m", "v2v_protocol.programs", "prepare", str(clips), str(folder / "prepared")]
    settings = ["--workers", "2", "--cache-dir", str(folder / "another cache")]
    status = subprocess.run([*prepare, *settings], stdout=subprocess.DEVNULL, check=False).returncode
    print(json.dumps({"lock": lock, "epoch": epoch, "prepared": status, "said": said}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
