"""Texts in YAML that would exhaust memory or the stack are refused; others give the values of SafeLoader."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.safe_yaml import (
    LARGEST_BYTES,
    MOST_LEVELS,
    YamlError,
    format_yaml,
    parse_yaml,
    read_yaml,
)

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(PLAIN)
def test_plain_values_come_back(value: object) -> None:
    assert parse_yaml(format_yaml(value)) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [x, x]\nb: [*a, *a]", r"an alias \(\*name\): write its value again"),
        ("&a [*a]", "an alias"),
        ("a: *b", "an alias"),
        ("[" * 40, f"more than {MOST_LEVELS} levels"),
        ("[" * 100_000, f"more than {MOST_LEVELS} levels"),
        ("{a: " * 40, f"more than {MOST_LEVELS} levels"),
        ("a: 1\na: 2", "'a' appears twice"),
        ('!!int ""', "does not fit"),
        ("!!bool 3", "does not fit"),
        ("!!timestamp x", "does not fit"),
        ("2020-02-31", "does not fit"),
        ("!!python/object/apply:os.getpid []", "could not determine a constructor"),
        ("a\0b", "special characters"),
    ],
)
def test_what_exceeds_a_limit_or_is_no_value_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(YamlError, match=message) as caught:
        parse_yaml(text)
    assert str(caught.value).isprintable()


def test_a_file_is_read_up_to_the_limit(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("a: 8:32\n#" + " " * (LARGEST_BYTES - 9), encoding="utf-8")
    assert read_yaml(file) == {"a": "8:32"}
    with file.open("a", encoding="utf-8") as more:
        more.write(" ")
    with pytest.raises(YamlError, match=f"more than {LARGEST_BYTES} bytes"):
        read_yaml(file)
    with pytest.raises(YamlError, match=f"more than {LARGEST_BYTES} bytes"):
        read_yaml("/dev/zero")
    file.write_bytes(b"a: \xe9")
    with pytest.raises(YamlError, match="not UTF-8 text"):
        read_yaml(file)
    with pytest.raises(YamlError, match="null byte"):
        read_yaml("a\0b")
