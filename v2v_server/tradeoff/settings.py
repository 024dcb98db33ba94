"""The ways to serve a corpus that are compared, each as a server's configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2v_protocol.safe_yaml import format_yaml
from v2v_server.tradeoff.forms import ENCODINGS, SOURCE

SAMPLES_PER_DECODE = (1, 2, 4)


@dataclass(frozen=True, slots=True)
class ServeSetting:
    """One way to serve a corpus.

    Attributes:
        form: SOURCE, or how the corpus is prepared: a key of ENCODINGS.
        samples_per_decode: of the StreamSpec.
    """

    form: str = SOURCE
    samples_per_decode: int = 1

    @property
    def name(self) -> str:
        """Return the name for tables, for example "source, K = 2"."""
        return f"{self.form}, K = {self.samples_per_decode}"

    def yaml(self, rows: str, why: str) -> str:
        """Return the setting as a file for ``v2v-serve --config``; ``why`` is one line about the choice."""
        lines = [f"# {self.name}: {why}"]
        if self.form != SOURCE:
            how = ENCODINGS[self.form]
            kind = f"--size {how.size}" if how.is_lossless else f"--quality {how.quality} --gop {how.gop}"
            flags = f"--rows {rows} --codec {how.codec} {kind}"
            lines += [f"# Prepare the corpus first: v2v-prepare SOURCE PREPARED {flags}", "# and serve PREPARED."]
        chosen = {"rows": rows, "samples_per_decode": self.samples_per_decode}
        return "\n".join([*lines, format_yaml(chosen)])


EXACT = ServeSetting()


def settings(forms: Sequence[str]) -> list[ServeSetting]:
    """Return the settings to compare: source and prepared forms, each with every number of samples per decode."""
    return [ServeSetting(form, count) for form in (SOURCE, *forms) for count in SAMPLES_PER_DECODE]


def write_preset(file: Path, record: Mapping[str, Any], rows: str, why: str) -> None:
    """Write the setting of a record (``form``, ``samples_per_decode``) as YAML."""
    chosen = ServeSetting(record["form"], record["samples_per_decode"])
    file.write_text(chosen.yaml(rows, why), encoding="utf-8")
