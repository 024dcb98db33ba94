"""The settings that buy speed: what a stream can be asked for, each as a server's configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from v2v_bench.tradeoff.forms import ENCODINGS, SOURCE
from v2v_protocol.spec import LOOP_FILTERS, LoopFilter

SAMPLES_PER_DECODE = (1, 2, 4)


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to serve a corpus.

    Attributes:
        form: SOURCE, or how the corpus is prepared: a key of ENCODINGS.
        loop_filter, samples_per_decode: of the StreamSpec.
    """

    form: str = SOURCE
    loop_filter: LoopFilter = "exact"
    samples_per_decode: int = 1

    @property
    def decoding(self) -> str:
        """What the pixels depend on: form and loop filter."""
        return self.form if self.loop_filter == "exact" else f"{self.form}, {self.loop_filter}"

    @property
    def name(self) -> str:
        return f"{self.decoding}, K = {self.samples_per_decode}"

    def yaml(self, rows: str, why: str) -> str:
        """The setting as a file for ``v2v-serve --config``.

        Args:
            rows: of the pictures, as for ``v2v-serve``.
            why: one line that says what it was chosen for.
        """
        lines = [f"# {self.name}: {why}"]
        if self.form != SOURCE:
            how = ENCODINGS[self.form]
            flags = f"--rows {rows} --codec {how.codec} --quality {how.quality} --gop {how.gop}"
            lines += [f"# Prepare the corpus first: v2v-prepare SOURCE PREPARED {flags}", "# and serve PREPARED."]
        chosen = {"rows": rows, "loop_filter": self.loop_filter, "samples_per_decode": self.samples_per_decode}
        return "\n".join([*lines, yaml.safe_dump(chosen, sort_keys=False)])


EXACT = Setting()


def settings(forms: Sequence[str]) -> list[Setting]:
    """All combinations: the source with every loop filter, the prepared forms as they are, each for every K.

    Prepared H.264 has no loop filter to skip, and the other codecs of ``v2v-prepare`` have none at all.
    """
    decodings = [(SOURCE, loop_filter) for loop_filter in LOOP_FILTERS] + [(form, "exact") for form in forms]
    return [Setting(*decoding, count) for decoding in decodings for count in SAMPLES_PER_DECODE]


def write_preset(file: Path, record: Mapping[str, Any], rows: str, why: str) -> None:
    """Writes the setting of a record (``form``, ``loop_filter``, ``samples_per_decode``) as YAML."""
    chosen = Setting(record["form"], record["loop_filter"], record["samples_per_decode"])
    file.write_text(chosen.yaml(rows, why), encoding="utf-8")
