"""Runs a Python module under a limit on the size of every file that it and its children write.

    python -m tests.faults.limited BYTES MODULE ARGUMENT ...

A write beyond the limit fails as on a full disk, with another reason ("File too large").
"""

import os
import resource
import sys

if __name__ == "__main__":
    limit = int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    os.execv(sys.executable, [sys.executable, "-m", *sys.argv[2:]])
