"""Build command lines: flags, help, and exit status.

Exit status: 0 success, 1 the command could not do its work, 2 wrong usage or input, 130 interrupted. Our own errors
print one line on stderr; ``--debug`` shows the traceback.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import textwrap
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Never

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.foreign_words import FOREIGN
from v2v_protocol.programs import COMPLETION, open_standard_streams, show, version_of
from v2v_protocol.settings import Setting, nearest, settings_of
from v2v_protocol.write_aside import JSON, check_output, check_outside

FAILED = 1
WRONG_USAGE = 2
INTERRUPTED = 128 + signal.SIGINT
_LONGEST_CHOICE = 30
_HELP_WIDTH = 100
_LISTS = ("--arrays", "--metrics", "--connect", "--page-names", "--keep-defects")
"""Flags whose value is a list with commas."""
_GENERAL = "General"
_FILES = ("FILE", "DIR", "VIDEO", "SRC", "DST", "PATH", "CONFIG", "RECORDING")
"""Words in the placeholder of an argument that names a file or folder."""
_FOLDERS = ("out", "cache")
"""Arguments that name a folder to write to, which may not lie in a folder of inputs."""
_NO_INPUTS = frozenset({*_FOLDERS, "destination", "cache_dir", "copies"})
"""Arguments that name a folder to write to."""


class Parser(argparse.ArgumentParser):
    """Flags of a command, in groups, with ``--help``, ``--version`` and ``--debug``.

    Args:
        name: name of the command.
        usage: text after the name in the first line of the help.
        description: what the command does, plain text.
        examples: command lines.
        status: meanings of its exit status beyond those of every command, plain text.
    """

    def __init__(self, name: str, usage: str, description: str, examples: Sequence[str], status: str = "") -> None:
        lines = ["examples:", *(f"  {example}" for example in examples), *(["", _wrapped(status)] if status else [])]
        super().__init__(
            prog=name,
            usage=f"{name} {usage}",
            description=_wrapped(description),
            epilog="\n".join(lines),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            add_help=False,
        )
        self._given: list[str] = []
        self._outputs: dict[str, tuple[str, Sequence[str]]] = {}
        self._groups: dict[str, argparse._ArgumentGroup] = {}
        general = self.group(_GENERAL)
        general.add_argument("-h", "--help", action="help", help="show this help and exit")
        general.add_argument("--version", action="version", version=version_of(name), help="show the version and exit")
        general.add_argument("--debug", action="store_true", help="show the traceback of an error")

    def group(self, title: str) -> argparse._ArgumentGroup:
        """Return the group with this title; create it on first use."""
        if title not in self._groups:
            self._groups[title] = self.add_argument_group(title)
        return self._groups[title]

    def add_settings(self, cls: Any, *names: str) -> None:
        """Add a flag for each setting of a dataclass, or for some; the value of a flag that is not given is None."""
        settings = settings_of(cls)
        for name, setting in [(name, settings[name]) for name in names or settings]:
            flag = flag_of(name)
            if setting.is_hidden:
                self.add_argument(flag, type=_reader(setting), help=argparse.SUPPRESS)
            elif setting.kind == "switch":
                self.group(setting.group).add_argument(
                    flag, action=argparse.BooleanOptionalAction, default=None, help=_help(setting)
                )
            else:
                bare = {} if setting.bare is None else {"nargs": "?", "const": setting.bare}
                self.group(setting.group).add_argument(
                    flag, type=_reader(setting), metavar=_metavar(setting), help=_help(setting), **bare
                )

    def add_output(self, group: str, flag: str, endings: Sequence[str], help: str, required: bool = False) -> None:
        """Add a flag for a file that the command writes. Before the work, :func:`run_command` checks the file.

        Args:
            endings: see :func:`check_output`; the first one is shown in the help if it is the only one.
        """
        metavar = f"FILE{endings[0]}" if len(endings) == 1 and endings != JSON else "FILE"
        must: dict[str, Any] = {"required": True} if required else {}
        self.group(group).add_argument(flag, type=Path, metavar=metavar, help=help, **must)
        self._outputs[flag.removeprefix("--").replace("-", "_")] = flag, endings

    def check_outputs(self, arguments: argparse.Namespace) -> None:
        """Check the files and folders to write against the other arguments that name files or folders.

        Raises:
            UsageError: see :func:`check_output` and :func:`check_outside`.
        """
        values = {name: value for name, value in vars(arguments).items() if name not in {*self._outputs, *_NO_INPUTS}}
        lists = (value if isinstance(value, list) else [value] for value in values.values())
        taken = [item for each in lists for item in each if isinstance(item, str | Path)]
        for name, (flag, endings) in self._outputs.items():
            if (path := getattr(arguments, name)) is not None:
                check_output(flag, path, endings, taken)
                taken.append(path)
        for name in _FOLDERS:
            if name not in self._outputs and isinstance(folder := getattr(arguments, name, None), str | Path):
                check_outside(flag_of(name), folder, taken)

    def format_help(self) -> str:
        """Format the help; options that every command has come last."""
        self._action_groups.sort(key=lambda group: group.title == _GENERAL)
        return super().format_help()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does, and keep the arguments for :meth:`error`."""
        self._given = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(args, namespace)

    def _joined(self, words: Sequence[str]) -> str:
        """Return an error that names the sign to write in place of the space before words; "" if there is none."""
        at = self._given.index(words[0]) if words[0] in self._given else 0
        sign_of = {"--rows": ":", "--set": "=", **dict.fromkeys(_LISTS, ",")}
        for flag, sign in sign_of.items():
            if at >= 2 and self._given[at - 2] == flag:
                parts = [self._given[at - 1], *words]
                if sign == "=" and all(sign in part for part in parts):
                    return f"{flag} {' '.join(parts)}: write {' '.join(f'{flag} {part}' for part in parts)}"
                joined = sign.join(filter(None, (part.strip(sign) for part in parts)))
                return f"{flag} {' '.join(parts)}: write {flag} {joined}, without a space"
        return ""

    def error(self, message: str) -> Never:
        """Exit with status 2 and one line. An unknown flag is reported before any other error."""
        known = self._option_string_actions
        for given in self._given:
            flag = given.partition("=")[0]
            if flag == "--":
                break
            if flag.startswith("--") and flag not in known:
                is_bare = flag in ("--video", "--videos") and "--videos" not in known
                key = flag[2:].replace("-", "_")
                hint = ": give the videos without a flag" if is_bare else nearest(flag, known)
                if {"--set", "--recipe"} <= known.keys():  # also fields of the recipe
                    hint = _of_recipe(key) or hint
                message = f"unknown flag {flag}{hint}"
                break
        else:
            if (rest := message.removeprefix("unrecognized arguments: ")) != message:
                message = self._joined(rest.split()) or message
            if (first := self._given[:1]) and os.path.exists(first[0]) and "--videos" in known:
                message = f"{first[0]}: give the videos with a flag, --videos {first[0]}"
        self.exit(WRONG_USAGE, f"{self.prog}: {message}; {self.prog} --help shows all flags\n")


def _of_recipe(key: str) -> str:
    """Return a hint to the field of a recipe that a flag names; "" if it names none."""
    from v2v_protocol.recipe import Recipe  # lazily: it loads NumPy, which --help does not need

    fields = settings_of(Recipe)
    meant = next((name for name in (key, *FOREIGN.get(key, ())) if name in fields), "")
    return f": it belongs to the recipe, --set {meant}=..." if meant else ""


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
    *,
    failures: tuple[type[V2VError], ...] = (),
    interrupted: str = "interrupted",
) -> int:
    """Parse the command line and run the command.

    Args:
        parser: parser of a command with a flag ``--debug``.
        run: returns the exit status; None is 0.
        argv: the command line; None takes that of the process.
        failures: errors that mean that the work failed (status 1), unless they are a UsageError; all other errors mean
            that the input was wrong (status 2).
        interrupted: message after a Ctrl-C; nothing if empty.

    Returns:
        what ``run`` returned, 1 or 2 after an error, or 130 after a Ctrl-C.
    """
    open_standard_streams()
    if shell := os.environ.get(COMPLETION):
        return _complete(parser, shell)
    try:
        arguments = parser.parse_args(argv)
    except SystemExit as ended:  # argparse's own: help was shown, or a flag not understood
        return int(ended.code or 0)
    try:
        if isinstance(parser, Parser):
            parser.check_outputs(arguments)
        return run(arguments) or 0
    except V2VError as error:
        if arguments.debug:
            traceback.print_exc()
        if not error.is_reported:
            show(f"{parser.prog}: {' '.join(str(error).split())}", sys.stderr)
        failed = isinstance(error, failures) and not isinstance(error, UsageError)
        return FAILED if failed else WRONG_USAGE
    except KeyboardInterrupt:
        if interrupted:
            print(f"{parser.prog}: {interrupted}", file=sys.stderr)
        return INTERRUPTED


def _complete(parser: argparse.ArgumentParser, shell: str) -> int:
    """Print the script with which a shell completes a command; return the exit status."""
    try:
        import shtab
    except ModuleNotFoundError:
        print("v2v: completion needs the Python package shtab: pip install shtab", file=sys.stderr)
        return WRONG_USAGE
    for action in parser._actions:
        if action.type is Path or any(word in str(action.metavar) for word in _FILES):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, shell))
    return 0


def flag_of(name: str) -> str:
    """Return the command-line flag of a setting."""
    return f"--{name.replace('_', '-')}"


def _wrapped(text: str) -> str:
    """Wrap each line of a text separately."""
    return "\n".join(textwrap.fill(line, _HELP_WIDTH) for line in text.split("\n"))


def _reader(setting: Setting) -> Callable[[str], Any]:
    """Return a function that converts the text of a flag to its value."""

    def read(text: str) -> Any:
        try:
            return setting.check("", {"whole": int, "number": float}.get(setting.kind, str)(text))
        except (ValueError, UsageError) as error:
            hint = nearest(text, setting.words)
            raise argparse.ArgumentTypeError(f"{text!r}: {setting.expected}{hint}") from error

    return read


def _metavar(setting: Setting) -> str:
    if setting.metavar:
        return setting.metavar
    if setting.kind == "word":
        choices = ",".join(setting.words)
        return f"{{{choices}}}" if len(choices) <= _LONGEST_CHOICE else "NAME"
    return {"whole": "N", "bounds": "N[:MOST]", "number": "X", "range": "X", "switch": "", "text": "TEXT"}[setting.kind]


def _help(setting: Setting) -> str:
    words = f": {', '.join(setting.words)}" if _metavar(setting) == "NAME" else ""
    default = ("off", "on")[setting.default] if setting.kind == "switch" else setting.default
    default = default[0] if setting.kind == "bounds" and default[0] == default[1] else default
    default = f"{default:g}" if isinstance(default, float) else default
    unit = f" {setting.unit}" if setting.unit else ""
    shown = "" if default == "" else f" (default {default}{unit})"
    return f"{setting.help}{words}{shown}".replace("%", "%%")
