"""Tables for notebooks: plain HTML, in which nothing that is shown can be markup."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any


def html_table(title: str, rows: Mapping[str, Any]) -> str:
    """A heading and one line for each row. Names and values are escaped: file names come from strangers."""
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(name))}</th>'
        f'<td style="text-align:left">{html.escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f"<b>{html.escape(title)}</b><table>{lines}</table>"
