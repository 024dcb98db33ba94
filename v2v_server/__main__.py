"""Run `v2v-serve` as `python -m v2v_server`. If its packages are not installed, it says so in one line."""

import sys

from v2v_protocol.programs import serve

if __name__ == "__main__":
    sys.exit(serve())
