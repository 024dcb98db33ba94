"""A hook of MkDocs: docstrings name other things as Sphinx does, :class:`Batch`; a page shows the name alone."""

from __future__ import annotations

import re
from typing import Any

_ROLE = re.compile(r":(?:class|meth|func|mod|data|attr|exc):(?=<code>)")


def on_page_content(html: str, **_: Any) -> str:
    """MkDocs calls it with the HTML of each page."""
    return _ROLE.sub("", html)
