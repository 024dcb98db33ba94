"""Run a benchmark: ``python -m bench NAME``."""

import sys

from bench.cli import main

sys.exit(main())
