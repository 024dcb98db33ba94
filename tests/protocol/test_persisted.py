"""Records that leave the process: each comes back equal, and any other is refused with a sentence that names class,
field, value and limit.
"""

from __future__ import annotations

import dataclasses
import importlib
import re
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.protocol.persisted_values import PLAIN, fits, hints_of, values_of
from v2v_client.position import ResumeState, StreamIdentity
from v2v_protocol.errors import ProtocolError, UsageError
from v2v_protocol.messages import Notes
from v2v_protocol.persisted import LARGEST_LIST, Int64, reader, to_plain
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, SampleId, SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.prepared import Header
from v2v_server.store.format import PACK_METHODS, Head

ROOT = Path(__file__).parents[2]
FOUND = [
    (".".join(file.relative_to(ROOT).with_suffix("").parts), name)
    for package in ("v2v_protocol", "v2v_server", "v2v_tools", "v2v_client")
    for file in sorted((ROOT / package).rglob("*.py"))
    for name in re.findall(r"^class (\w+)\((?:Persisted|Noted)\)", file.read_text(), re.MULTILINE)
]
CLASSES: list[Any] = [getattr(importlib.import_module(module), name) for module, name in FOUND]
ID = SampleId("s" * 32, "c" * 32, 4, 2**64 - 1, 2**32 - 1, 2**48 - 1)
PARAMS = SampleParams(0.2, 0.3, 0.1, 2, 1.5, ((4, 2),), 1.0, 1, 2, True, 0.0, (1, 2, 3, 2**32 - 1), {"leak_hz": 0.5})
STREAM = StreamIdentity({"recipe": {"gamma": 2.2}}, "s" * 32, "c" * 32, 4, 100)
EXAMPLES: dict[type[Any], Any] = {
    Head: Head("v", "1-a", 8, 8, 0, 8, 0, 5, 5, 30.0, "h264", True, 2, next(iter(PACK_METHODS))),
    Header: Header("full", "fast", 3, "videos", "d" * 32),
    SampleId: ID,
    SampleParams: PARAMS,
    Provenance: Provenance(ID, "v", "1-a", 0, 0, (), PARAMS, 0, 0, "h264"),
    Recipe: Recipe(),
    StreamSpec: StreamSpec(),
    ResumeState: ResumeState(STREAM, 3, 1, 0, 40, 2, None, 7),
}
"""Classes whose fields also have to fit each other."""
OF_OTHER_FORM = (Recipe, StreamSpec, ResumeState, Notes)
"""Classes that read more than they write: presets and parts of a recipe, a stream beside the place in it, what is
ignored.
"""
WITH_PICTURES = ("Excerpt",)
"""Classes with the index of a real video: tests of isolated processes have them."""
checked = [cls for cls in CLASSES if cls not in OF_OTHER_FORM and cls.__name__ not in WITH_PICTURES]
each_class = pytest.mark.parametrize("cls", checked, ids=lambda cls: cls.__name__)


def items(cls: Any) -> st.SearchStrategy[Any]:
    return st.just(EXAMPLES[cls]) if cls in EXAMPLES else values_of(cls)


def written(item: Any) -> dict[str, Any]:
    plain: dict[str, Any] = msgpack.unpackb(msgpack.packb(item, default=to_plain))
    return plain


def test_every_class_that_leaves_the_process_is_found() -> None:
    names = {cls.__name__ for cls in CLASSES}
    assert names >= {
        "Hello", "Lease", "Refusal", "PreparedVideo", "QuarantineEntry", "PeerKey", "IndexRow", "LoaderShare",
    }  # fmt: skip
    assert set(EXAMPLES) <= set(CLASSES)
    assert len(CLASSES) > 35


@each_class
@given(st.data())
def test_a_record_comes_back_as_it_was(cls: Any, data: st.DataObject) -> None:
    item = data.draw(items(cls))
    plain = written(item)
    again = cls.from_dict(plain)
    assert written(again) == plain
    assert type(again) is cls
    if "nan" not in repr(item):
        assert again == item


@pytest.mark.parametrize("cls", [cls for cls in checked if hints_of(cls)], ids=lambda cls: cls.__name__)
@given(st.data())
def test_a_malformed_field_is_refused_by_class_field_value_and_limit(cls: Any, data: st.DataObject) -> None:
    hints = hints_of(cls)
    plain, name = written(data.draw(items(cls))), data.draw(st.sampled_from(list(hints)))
    value = data.draw(PLAIN | st.floats() | st.integers(-(2**63), 2**64 - 1))
    try:
        again = cls.from_dict(plain | {name: value})
    except ProtocolError as error:
        said = str(error)
        assert said.startswith(f"{cls.__name__}.{name} ") or (said.startswith(cls.__name__) and cls in EXAMPLES)
        assert re.search(r"= .*: (expected|give|unknown)|has|lacks|limit|bytes", said) or cls in EXAMPLES
        assert len(said) < 600
        assert not fits(hints[name], value) or cls in EXAMPLES or _holds_record(hints[name])
    else:
        assert fits(hints[name], value)
        assert written(again) is not None


def _holds_record(hint: Any) -> bool:
    return "v2v_" in repr(hint)


@each_class
@settings(max_examples=10)  # names of fields, not their values
@given(st.data())
def test_fields_that_are_missing_or_unknown(cls: Any, data: st.DataObject) -> None:
    """A field with a default may be missing, as in records of earlier releases; no other, and none may be added."""
    plain = written(data.draw(items(cls)))
    for field in dataclasses.fields(cls):
        rest = {name: value for name, value in plain.items() if name != field.name}
        if field.default is not dataclasses.MISSING:
            assert getattr(cls.from_dict(rest), field.name) == field.default
        elif field.default_factory is dataclasses.MISSING:
            with pytest.raises(ProtocolError, match=f"^{cls.__name__} lacks {field.name}$"):
                cls.from_dict(rest)
    for key in ("more", "", "self", b"lease", 7):
        with pytest.raises(ProtocolError, match=rf"^{cls.__name__} has no field .*; its fields are "):
            cls.from_dict(plain | {key: 1})


@each_class
@settings(max_examples=20)
@given(PLAIN)
def test_what_is_no_record_is_refused(cls: Any, value: Any) -> None:
    assume(not isinstance(value, dict))
    with pytest.raises(ProtocolError, match=f"^{cls.__name__} = .*: expected a map of its fields"):
        cls.from_dict(value)


def test_numbers_have_limits_and_lists_a_length() -> None:
    assert reader(Int64)(-(2**63)) == -(2**63)
    for kind, value, said in (
        (int, -1, "= -1: expected a whole number from 0 to 18446744073709551615"),
        (Int64, 2**63, f"= {2**63}: expected a whole number from -9223372036854775808 to 9223372036854775807"),
        (float, float("nan"), "= nan: expected a finite number"),
        (float, 10**400, "expected a finite number"),
        (tuple[int, ...], [0] * (LARGEST_LIST + 1), f"= a list of 65537: expected a list of at most {LARGEST_LIST}"),
        (tuple[int, str], [0], "= a list of 1: expected a list of 2"),
        (str | None, 1, "= 1: expected str or NoneType"),
    ):
        with pytest.raises(ProtocolError, match=re.escape(said)):
            reader(kind)(value)


def test_a_field_that_does_not_fit_the_others_is_refused_in_its_own_words() -> None:
    with pytest.raises(ProtocolError, match=r"^SampleId: epoch = .*: give a whole number from 0 to 4294967295$"):
        SampleId.from_dict(ID.to_dict() | {"epoch": 2**33})
    with pytest.raises(ProtocolError, match=r"^SampleParams: unknown effect 'leak'.*did you mean 'leak_hz'"):
        SampleParams.from_dict(PARAMS.to_dict() | {"effects": {"leak": 1.0}})
    with pytest.raises(UsageError, match=r"ResumeState.seed = -1: expected a whole number from 0 to"):
        ResumeState.from_dict(EXAMPLES[ResumeState].to_dict() | {"seed": -1})
