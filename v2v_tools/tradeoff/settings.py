"""The ways to serve a corpus that are compared: every form of it, with all values of some fields."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from v2v_protocol.errors import UsageError
from v2v_protocol.safe_yaml import format_yaml, parse_yaml
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import recipe_setting
from v2v_server.store.planes import OPTIONAL, PLANES
from v2v_tools.tradeoff.forms import BESIDE, SOURCE, STORES

SAMPLES_PER_DECODE = (1, 2, 4)
DEFAULT_AXES = {"samples_per_decode": ("1", "2", "4"), "substep_px": ("0", "1")}
"""Values of each field that are compared unless the user names others."""
_SPEC_FIELDS = ("samples_per_decode", "substep_px", "tolerance")
Axes = Mapping[str, Sequence[str]]


@dataclass(frozen=True, slots=True)
class ServeSetting:
    """One way to serve a corpus.

    Attributes:
        form: SOURCE, BESIDE, or how the corpus is prepared: a key of STORES.
        spec: what is streamed.
        values: what tells it from other settings of the form, for example "substep_px = 1"; K is apart.
    """

    form: str
    spec: StreamSpec
    values: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return the name for tables, for example "source, K = 2"."""
        return ", ".join((self.form, f"K = {self.spec.samples_per_decode}", *self.values))

    @property
    def way(self) -> str:
        """Return the name without K, on which the samples do not depend."""
        return ", ".join((self.form, *self.values))

    @property
    def single(self) -> ServeSetting:
        """Return the setting of one sample a decode, whose samples have the same bytes."""
        return dataclasses.replace(self, spec=dataclasses.replace(self.spec, samples_per_decode=1, sibling_spacing=0))

    def yaml(self, rows: str, why: str) -> str:
        """Return the setting as a file for ``v2v-serve --config``; ``why`` is one line about the choice."""
        lines = [f"# {self.name}: {why}"]
        if self.form == BESIDE:
            lines += ["# Serve the folder of --beside."]
        elif self.form != SOURCE:
            planes = "".join(f" --planes {name}" for name in planes_for([self.spec]))
            flags = f"--rows {rows} --size {STORES[self.form]}{planes}"
            lines += [f"# Prepare the corpus first: v2v-prepare SOURCE PREPARED {flags}", "# and serve PREPARED."]
        plain, usual = self.spec.to_dict(), StreamSpec().to_dict()
        recipe = _different(plain.pop("recipe"), usual.pop("recipe"))
        chosen = {"rows": rows, "samples_per_decode": self.spec.samples_per_decode, **_different(plain, usual)}
        return "\n".join([*lines, format_yaml(chosen | ({"recipe": recipe} if recipe else {}))])


def planes_for(specs: Iterable[StreamSpec]) -> tuple[str, ...]:
    """Return the planes of a store that these streams read."""
    specs = tuple(specs)
    return tuple(name for name in OPTIONAL if any(getattr(spec, PLANES[name].serves, 0) for spec in specs))


def _different(values: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in usual or value != usual[name]}


def axes(texts: Iterable[str]) -> Axes:
    """Return DEFAULT_AXES, changed by texts "KEY=VALUE,VALUE".

    Raises:
        UsageError: a text has another form.
    """
    found: dict[str, Sequence[str]] = dict(DEFAULT_AXES)
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals:
            raise UsageError(f"--vary {text}: write KEY=VALUE,VALUE, for instance --vary voxel_seconds=0.02,0.1")
        found[key] = list(dict.fromkeys(value.strip() for value in values.split(",")))
    return found


def settings(forms: Sequence[str], spec: StreamSpec, varied: Axes) -> list[ServeSetting]:
    """Return every combination of the source or a form, and one value of each axis.

    Raises:
        UsageError: a field is unknown, or a value is wrong.
    """
    streams = []
    for values in itertools.product(*varied.values()):
        stream, names = spec, []
        for key, value in zip(varied, values, strict=True):
            stream = _changed(stream, key, value)
            if key != "samples_per_decode" and len(varied[key]) > 1:
                names.append(f"{key} = {value}")
        streams.append((stream, tuple(names)))
    return [ServeSetting(form, *stream) for form in (SOURCE, *forms) for stream in streams]


def full_model(setting: ServeSetting, compared: Sequence[ServeSetting]) -> ServeSetting:
    """Return what a setting is judged by: the source, the shortest sub-steps of all that are compared, all effects."""
    finest = min((each.spec.substep_px for each in compared if each.spec.substep_px), default=0.0)
    single = setting.single
    return ServeSetting(SOURCE, dataclasses.replace(single.spec, substep_px=finest, tolerance=0.0))


def _changed(spec: StreamSpec, key: str, value: str) -> StreamSpec:
    if key not in _SPEC_FIELDS:
        return dataclasses.replace(spec, recipe=recipe_setting(None, [f"{key}={value}"], spec.recipe.to_dict()))
    changed = StreamSpec.from_dict({key: parse_yaml(value)}, spec)
    if changed.samples_per_decode not in SAMPLES_PER_DECODE:
        raise UsageError(f"--vary {key}={value}: choose from {', '.join(map(str, SAMPLES_PER_DECODE))}")
    return changed
