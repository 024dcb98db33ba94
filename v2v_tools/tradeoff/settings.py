"""The ways to serve a corpus that are compared: every form of it, with all values of some fields.

The forms are the corpus as it is, as another folder has it, and as stores. Everything is in a temporary folder: links
to a few different clips of the corpus and of the other folder, and stores, made by the functions of ``v2v-prepare``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.programs import counted, show
from v2v_protocol.safe_yaml import format_yaml, parse_yaml
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import recipe_setting
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.prepare import prepare
from v2v_server.schedule import SequenceTable
from v2v_server.store.planes import OPTIONAL, PLANES
from v2v_server.video.rows import Rows

SOURCE, BESIDE = "source", "beside"
STORES = {"lossless dense": "dense", "lossless fast": "fast", "lossless raw": "raw"}
"""Sizes of stores, by form."""
SAMPLES_PER_DECODE = (1, 2, 4)
DEFAULT_AXES = {"samples_per_decode": ("1", "2", "4"), "substep_px": ("0", "1")}
"""Values of each field that are compared unless the user names others."""
_SPEC_FIELDS = ("samples_per_decode", "substep_px")
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
    def exact(self) -> ServeSetting:
        """Return the same from exactly decoded frames: what a store or another encoding is judged by."""
        return dataclasses.replace(self.single, form=SOURCE)

    @property
    def single(self) -> ServeSetting:
        """Return the setting of one sample a decode, whose samples have the same bytes."""
        return dataclasses.replace(self, spec=dataclasses.replace(self.spec, samples_per_decode=1, sibling_spacing=0))

    def yaml(self, rows: str, why: str) -> str:
        """Return the setting as a file for ``v2v-serve --config``; ``why`` are lines about the choice."""
        lines = [f"# {line}" for line in f"{self.name}: {why}".splitlines()]
        if self.form == BESIDE:
            lines += ["# Serve the folder of --beside."]
        elif self.form != SOURCE:
            planes = "".join(f" --planes {name}" for name in planes_for([self.spec]))
            flags = f"--rows {rows} --size {STORES[self.form]}{planes}"
            lines += [f"# Prepare the corpus first: v2v-prepare SOURCE PREPARED {flags}", "# and serve PREPARED."]
        chosen = {"rows": rows, "samples_per_decode": self.spec.samples_per_decode}
        return "\n".join([*lines, format_yaml(chosen | _changes(self.spec.to_dict(), StreamSpec().to_dict()))])


def _changes(values: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that differ from the usual ones; of a mapping those in it."""
    changed = {name: value for name, value in values.items() if usual.get(name) != value}
    return {name: _changes(value, usual[name]) if name == "recipe" else value for name, value in changed.items()}


def planes_for(specs: Iterable[StreamSpec]) -> tuple[str, ...]:
    """Return the planes of a store that these streams read."""
    specs = tuple(specs)
    return tuple(name for name in OPTIONAL if any(getattr(spec, PLANES[name].serves, 0) for spec in specs))


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


def _changed(spec: StreamSpec, key: str, value: str) -> StreamSpec:
    if key not in _SPEC_FIELDS:
        return dataclasses.replace(spec, recipe=recipe_setting(None, [f"{key}={value}"], spec.recipe.to_dict()))
    changed = StreamSpec.from_dict({key: parse_yaml(value)}, spec)
    if changed.samples_per_decode not in SAMPLES_PER_DECODE:
        raise UsageError(f"--vary {key}={value}: choose from {', '.join(map(str, SAMPLES_PER_DECODE))}")
    return changed


@contextlib.contextmanager
def open_forms(
    videos: Path, rows: Rows, compared: Sequence[ServeSetting], *, beside: Path | None, most_clips: int, folder: Path
) -> Iterator[dict[str, Catalogue]]:
    """Yield the clips in every form of some settings, by its name; equal indices give equal draws in all of them.

    Args:
        videos: the corpus, not a prepared one.
        rows: rows of the pictures to use.
        compared: the settings. The first one decides which clips are long and large enough.
        beside: a folder that has each clip under the same name, in another encoding; None: there is none.
        most_clips: number of clips to take: the first different ones.
        folder: an empty folder for all files.

    Raises:
        CorpusError: there is no clip, one could not be prepared, or ``beside`` lacks one or has it with other frames.
        UsageError: the corpus is a prepared one.
    """
    with contextlib.ExitStack() as stack:

        def opened(path: Path, of: Rows | None = None) -> Catalogue:
            catalogue = open_catalogue(path, rows=of, cache_dir=folder / "cache", processes=0)
            stack.callback(catalogue.close)
            return catalogue

        chosen = _chosen(opened(videos, rows), compared[0].spec, most_clips)
        source = opened(_link(videos, chosen, folder / "clips"), rows)
        made = {SOURCE: source}
        for name in dict.fromkeys(setting.form for setting in compared):
            if name == BESIDE and beside is not None:
                made[name] = opened(_link(beside, chosen, folder / BESIDE), rows)
                _require_alike(source, made[name], beside)
            elif name in STORES:
                show(f"preparing {counted(len(source.videos), 'clip')} as {name}", sys.stderr)
                into, planes = folder / STORES[name], planes_for(setting.spec for setting in compared)
                if failed := prepare(source, into, STORES[name], processes=0, planes=planes).failed:
                    raise CorpusError(f"{failed[0].id} could not be prepared as {name}: {failed[0].problem}")
                made[name] = opened(into)
        yield made


def _chosen(catalogue: Catalogue, spec: StreamSpec, most: int) -> list[str]:
    """Return the ids of the first different clips."""
    if catalogue.prepared is not None:
        raise UsageError(f"--videos {catalogue.folder}: a prepared corpus; give its source")
    table = SequenceTable(catalogue.videos, catalogue.rows, spec)
    if not table.count:
        raise CorpusError(f"--videos {catalogue.folder}: no video gives a sequence: {table.refusals[0]}")
    unusable = {refusal.video for refusal in table.refusals}
    distinct = {video.fingerprint: video for video in reversed(catalogue.videos) if video.id not in unusable}
    return sorted(video.id for video in distinct.values())[:most]


def _link(videos: Path, ids: Sequence[str], folder: Path) -> Path:
    """Link some videos of a folder, or of the folder of a list file, under names that tell them apart."""
    root = videos if videos.is_dir() else videos.parent
    folder.mkdir(parents=True)
    for number, id in enumerate(ids):
        if not (root / id).exists():
            raise CorpusError(f"{root / id}: there is no such file: give a folder with each clip under its own name")
        (folder / f"{number:03d}_{Path(id).name}").symlink_to((root / id).resolve())
    return folder


def _require_alike(source: Catalogue, other: Catalogue, folder: Path) -> None:
    """Check that both have the same videos, with equal numbers and sizes of frames."""
    for video in source.videos:
        found = other.videos.find(video.id)
        if found is None:
            raise CorpusError(f"{folder}: {video.id[4:]} cannot be used")
        wanted, has = (
            f"{each.frames} frames of {each.width_px}x{each.height_px} px" for each in (video, other.videos[found])
        )
        if has != wanted:
            raise CorpusError(
                f"{folder}: {video.id[4:]} has {has} instead of {wanted}: encode it again with all frames in their size"
            )
