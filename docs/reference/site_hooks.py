"""Hooks of MkDocs: pages of the repository's root on the site, and plain names for Sphinx roles in docstrings."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parents[2]
_PAGES = {name: name.lower() for name in ("CHANGELOG.md", "SECURITY.md", "CONTRIBUTING.md")}
_LINK = re.compile(rf"\]\((?:\.\./)*({'|'.join(map(re.escape, _PAGES))})")
_ROLE = re.compile(r":(?:class|meth|func|mod|data|attr|exc):(?=<code>)")


def on_files(files: Files, config: Any) -> Files:
    """Add the root's pages to the site."""
    for name, page in _PAGES.items():
        text = (_ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text.replace("](docs/", "](")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links to the root's pages lead to their copies on the site."""
    up = "../" * (len(PurePosixPath(page.file.src_uri).parts) - 1)
    return _LINK.sub(lambda found: f"]({up}{_PAGES[found[1]]}", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Remove the role in front of a name."""
    return _ROLE.sub("", html)
