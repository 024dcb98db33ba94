"""Runs a Python module under a limit on the size of every file that it and its children write.

    python -m tests.faults.limited BYTES MODULE ARGUMENT ...

A write beyond the limit fails as on a full disk, with another reason ("File too large"). They write no bytecode: Python
would keep files that the limit has cut, for all processes after them.
"""

import os
import resource
import sys

if __name__ == "__main__":
    limit = int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    os.execv(sys.executable, [sys.executable, "-m", *sys.argv[2:]])
