"""Write what a command measured or did to a JSON file: one list of flat records."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from v2v_protocol.write_aside import write_file


def write_json(file: str | os.PathLike[str], records: Sequence[Mapping[str, Any]]) -> None:
    """Write the records of a command's ``--json FILE``.

    Raises:
        UsageError: the file cannot be written.
    """
    write_file(Path(file), json.dumps(records, indent=1) + "\n", "--json")
