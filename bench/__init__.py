"""Benches: what is measured again and again. Not installed; run ``python -m bench NAME`` in a checkout."""
