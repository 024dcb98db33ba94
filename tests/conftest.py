"""What holds for every test."""

from __future__ import annotations

import os

from hypothesis import settings

# Hypothesis fails an example that takes longer than 200 ms: a timing assertion, which a busy machine breaks.
settings.register_profile("v2v", deadline=None, print_blob=True)
settings.register_profile("ci", parent=settings.get_profile("v2v"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "v2v")
