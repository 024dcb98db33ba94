"""The snippets whose types `make check` checks."""

from tests.tools.snippets import PAGES, snippets


def test_each_page_has_some() -> None:
    assert all(snippets(page) for page in PAGES)
