"""`python -m v2v_server` is `v2v-serve`, also where its packages are not installed: it says so in a line."""

import sys

from v2v_protocol.programs import serve

if __name__ == "__main__":
    sys.exit(serve())
