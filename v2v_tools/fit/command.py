"""`v2v-fit`: arguments -> call."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_pictures.files import write_png
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_protocol.progress import Progress
from v2v_protocol.spec_flags import read_yaml_mapping, recipe_setting
from v2v_recordings.items import add_options, options_of
from v2v_recordings.reading import FORMS
from v2v_tools.fit.fit import fit
from v2v_tools.fit.lab import camera_of, measure, table
from v2v_tools.fit.report import draw_fit, report_lines, write_recipe


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-fit", "RECORDING --out CAMERA.yaml [flags]   or   --check RECIPE [flags]",
        "Fit a virtual camera to a recording of a real one, or measure a recipe as a laboratory does.",
        [
            "v2v-fit recording.aedat4 --out my_camera.yaml --picture my_camera.png",
            "v2v-fit dark_room.raw --static --out noise.yaml",
            "v2v-fit --check my_camera.yaml --sheet datasheet.yaml",
        ],
        "Forms of recordings:\n" + "\n".join(f"  {name:14s} {form.title}" for name, form in FORMS.items()),
    )  # fmt: skip
    recording = parser.group("Recording")
    recording.add_argument("recording", nargs="?", metavar="RECORDING", help="file or folder with events; frames help")
    recording.add_argument("--static", action="store_true", help="nothing moved: all events are noise")
    add_options(recording)
    parser.add_output(
        "Output", "--out", (".yaml", ".yml"), "recipe to write (.yaml); --recipe of the other commands reads it"
    )
    parser.add_output("Output", "--picture", (".png",), "also draw measured against simulated statistics")
    check = parser.group("Check")
    check.add_argument("--check", metavar="RECIPE", help="measure this recipe: its name or a YAML file")
    check.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="with --check: change one recipe field"
    )
    check.add_argument("--sheet", metavar="FILE.yaml", help="figures to show in the table, by its row names")
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="interrupted; no recipe was written")


def _run(arguments: argparse.Namespace) -> None:
    if arguments.recording is None and arguments.check is None:
        raise UsageError("nothing to do: give a RECORDING and --out, or --check RECIPE")
    if (arguments.recording is None) != (arguments.out is None):
        raise UsageError("a RECORDING and --out belong together: give both, or neither with --check")
    for flag, value in (("--sheet", arguments.sheet), ("--set", arguments.set)):
        if value and arguments.check is None:
            raise UsageError(f"{flag} needs --check")
    for flag in ("--static", "--size", "--time-unit", "--picture", "--light"):
        if arguments.recording is None and getattr(arguments, flag[2:].replace("-", "_")):
            raise UsageError(f"{flag} needs a RECORDING")
    if arguments.recording is not None:
        _fit(arguments)
    if arguments.check is not None:
        recipe = recipe_setting(arguments.check, arguments.set)
        recipe.warn()
        columns = {"recipe": measure(camera_of(recipe))}
        if arguments.sheet is not None:
            columns["sheet"] = _sheet(arguments.sheet)
        show(table(columns))


def _fit(arguments: argparse.Namespace) -> None:
    options = options_of(arguments)
    source, out = Path(arguments.recording), arguments.out
    with Progress(source.name, "%") as progress:
        fitted = fit(source, static=arguments.static, options=options, progress=progress)
    show("\n".join(report_lines(fitted, source.name)))
    if not fitted.camera:
        raise V2VError(
            f"{source}: no parameter could be fitted, so no recipe was written: record more events and more change of "
            "light, as docs/guides/fit-your-camera.md describes"
        )
    write_recipe(out, fitted, source.name)
    if arguments.picture is not None:
        write_png(arguments.picture, draw_fit(fitted, source.name))


def _sheet(file: str) -> dict[str, float]:
    values = read_yaml_mapping("--sheet", file)
    for name, value in values.items():
        if not isinstance(value, int | float):
            raise UsageError(f"--sheet {file}: {name} = {value!r}: give a number")
    return {name: float(value) for name, value in values.items()}


if __name__ == "__main__":
    sys.exit(main())
