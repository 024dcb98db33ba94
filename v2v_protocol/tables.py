"""Format tables for notebooks as plain HTML without markup from the values."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any


def html_table(title: str, rows: Mapping[str, Any]) -> str:
    """Return a heading and one line for each row. Names and values are escaped: file names come from untrusted
    sources.
    """
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(name))}</th>'
        f'<td style="text-align:left">{html.escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f"<b>{html.escape(title)}</b><table>{lines}</table>"
