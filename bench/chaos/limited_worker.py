"""A worker whose control group has the limit of memory that a folder states, as a container would.

python -m bench.chaos.limited_worker FOLDER, then the arguments of v2v-worker
"""

from __future__ import annotations

import sys
from pathlib import Path

from v2v_server.commands.worker import main
from v2v_server.system import process

MODULE = "bench.chaos.limited_worker"


def write_limit(folder: Path, limit_bytes: int) -> None:
    """Write the files of a control group with a limit."""
    folder.mkdir()
    for name, text in (("own", "0::/"), ("memory.max", str(limit_bytes)), ("memory.current", "0")):
        (folder / name).write_text(f"{text}\n", encoding="ascii")


if __name__ == "__main__":
    limits = Path(sys.argv.pop(1))
    process.control_groups.__defaults__ = limits, limits / "own"
    sys.exit(main())
