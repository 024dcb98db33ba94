"""Check every command line in the documentation, `deploy/` and the examples: its flags exist, and the program's own
parser accepts each line of a code block."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

from bench.__main__ import BENCHES, parser_for
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError

ROOT = Path(__file__).parents[1]
MODULES = {
    "v2v-serve": "v2v_server.commands.serve",
    "v2v-worker": "v2v_server.commands.worker",
    "v2v-simulate": "v2v_tools.simulate",
    "v2v-preview": "v2v_tools.preview",
    "v2v-prepare": "v2v_server.commands.prepare",
    "v2v-catalogue": "v2v_server.commands.catalogue",
    "v2v-quarantine": "v2v_server.commands.quarantine",
    "v2v-top": "v2v_server.commands.top",
    "v2v-doctor": "v2v_tools.doctor.command",
    "v2v-keys": "v2v_server.commands.keys",
    "v2v-tradeoff": "v2v_tools.tradeoff.command",
    "v2v-fit": "v2v_tools.fit.command",
    "v2v-loadtest": "v2v_client.loadtest",
    "v2v-train": "trainer.train",
    "v2v-eval": "trainer.evaluation.cli",
    "v2v-convert": "trainer.convert.cli",
}
_LAUNCHED = {
    "trainer.train": "trainer.train",
    "examples/overfit.py": "examples.overfit",
    "examples/detect.py": "examples.detect",
    "examples/render_sprites.py": "examples.render_sprites",
    "examples.ray_train": "examples.ray_train",
    "trainer.run.export": "trainer.run.export",
    "tests.tools.trace": "tests.tools.trace",
}
"""What `python` and `torchrun` start beside benches."""
_MODES = {
    ("v2v-train", "export"): "trainer.run.export",
    ("v2v-train", "data"): "trainer.run.data",
    ("v2v-simulate", "--whole"): "v2v_tools.whole",
    ("v2v-simulate", "--count"): "v2v_tools.sample_set",
}
"""Modules with the parser of a program that has other flags beside this word."""
_STANDS_FOR_ANY = {"train.py": "the reader's own script"}
PAGES = sorted(
    page
    for pattern in (
        *("README.md", "docs/*.md", "docs/guides/*.md", "docs/reference/*.md"),
        *("deploy/**/*", "examples/*.py", "examples/*.sh"),
    )
    for page in ROOT.glob(pattern)
    if page.is_file()
)
"""Decisions and notes are of their day, and stay as they were."""
_LINE = re.compile(r"\b(v2v[- ][a-z]+)((?: [^\n`|;&#)]*)?)")
_WORD = re.compile(r"(?<=\s)(--[a-z][a-z-]*|export|data(?= firenet))")


class _Caught(Exception):
    pass


@cache
def parser_of(module: str) -> argparse.ArgumentParser:
    """Return the parser with which the ``main`` of a module reads its command line."""
    found: list[argparse.ArgumentParser] = []

    def parse(self: argparse.ArgumentParser, *_: object) -> None:
        found.append(self)
        raise _Caught

    main = import_module(module).main
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        patch.setattr(argparse.ArgumentParser, "parse_known_args", parse)
        patch.setattr(sys, "argv", ["program"])
        with pytest.raises(_Caught):
            main()
    return found[0]


def module_of(program: str, words: Sequence[str] = ()) -> str:
    """Return the module whose parser reads these words."""
    return next((_MODES[program, word] for word in words if (program, word) in _MODES), MODULES[program])


def flags_of(program: str, words: Sequence[str] = ()) -> frozenset[str]:
    """Return all flags that the program knows beside these words."""
    return frozenset(parser_of(module_of(program, words))._option_string_actions)


def command_lines(text: str) -> list[tuple[str, list[str]]]:
    """Yield (program, its words) for each command line in a text. A backslash at the end continues a line."""
    joined = re.sub(r"\\\n\s*#?\s*", " ", text)
    return [
        (program, _WORD.findall(rest))
        for said, rest in _LINE.findall(joined)
        if (program := said.replace(" ", "-")) in MODULES
    ]


def test_command_lines_are_found_in_texts() -> None:
    text = "Say `v2v-serve --videos DIR --bind=x`, or\n    v2v worker --connect A \\\n      --cache B  # --no flag\n"
    assert command_lines(text) == [("v2v-serve", ["--videos", "--bind"]), ("v2v-worker", ["--connect", "--cache"])]


def test_every_program_is_checked() -> None:
    named = {value.strip('"') for value in re.findall(r"^(v2v-\w+) = ", (ROOT / "pyproject.toml").read_text(), re.M)}
    assert named == set(MODULES)
    assert {"--videos", "--no-shuffle"} <= flags_of("v2v-serve")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_shown_flags_exist(page: Path) -> None:
    wrong = [
        f"{program} {word}"
        for program, words in command_lines(page.read_text(encoding="utf-8"))
        for word in words
        if word[0] == "-" and word not in flags_of(program, words)
    ]
    assert wrong == []


def test_images_start_programs_with_valid_flags() -> None:
    lists = [
        *re.findall(r"^(?:ENTRYPOINT|CMD) (\[.*\])$", (ROOT / "deploy" / "Dockerfile").read_text(), re.M),
        *re.findall(r"command: (\[\"--.*\])$", (ROOT / "deploy" / "compose.yaml").read_text(), re.M),
    ]
    assert len(lists) == 3
    assert set(_WORD.findall(" ".join(lists).replace('"', " "))) <= flags_of("v2v-serve")
    (train,) = re.findall(r"command: (\[\"\$.*\])$", (ROOT / "deploy" / "compose.yaml").read_text(), re.M)
    assert set(_WORD.findall(train.replace('"', " "))) <= flags_of("v2v-train")


def block_lines(text: str) -> list[list[str]]:
    """Yield the words of each line in a page's code blocks, without the prompt that names the host, and without
    environment variables."""
    text = re.sub(r" *\\\n\s*", " ", re.sub(r"^```python.*?^```", "", text, flags=re.M | re.S))
    lines = re.findall(
        r"^ {4}(?:\w+\$ +)?((?:[A-Z_]+=\S+ )*(?:v2v-|uvx |torchrun |python |pip |make |pytest ).*)$", text, re.M
    )
    # A sentence names a bench, with some of its flags.
    lines += re.findall(r"`((?:uvx|torchrun|python -m(?! bench)|pip|make|pytest) [^`]+)`", text)
    return [shlex.split(re.sub(r"^(?:[A-Z_]+=\S+ )+", "", line), comments=True) for line in lines]


def wrong_with(words: list[str]) -> str:
    """Return what is wrong with a command line; "" if it is valid."""
    program, *rest = words
    if program == "uvx":
        return wrong_with(rest[rest.index("--from") + 2 :])
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
        return "" if {word for word in rest if "=" not in word} <= set(targets) else f"make knows {targets}"
    if program == "pip":
        extras = re.findall(r"\[([a-z,]+)\]", " ".join(rest))
        known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        return "" if set(",".join(extras).split(",")) <= {*known, ""} else f"extras are {sorted(known)}"
    if program == "pytest":
        missing = [word for word in rest if word.startswith("tests/") and not (ROOT / word).exists()]
        return f"there is no {missing}" if missing else ""
    if program in ("python", "torchrun"):
        return _wrong_with_launched(rest)
    if program not in MODULES:
        return "no program"
    mode = rest[:1] in (["export"], ["data"])
    return _refused(parser_of(module_of(program, rest)), rest[mode:])


def _wrong_with_launched(words: list[str]) -> str:
    """Check what follows `python` or `torchrun`: their own flags, then -m MODULE or a script, then its flags."""
    if words[:1] == ["-c"]:
        return ""
    at = words.index("-m") + 1 if "-m" in words else next(n for n, word in enumerate(words) if word.endswith(".py"))
    started, rest = words[at], words[at + 1 :]
    if started in _STANDS_FOR_ANY:
        return ""
    if started == "pytest":
        return wrong_with(["pytest", *rest])
    if started == "bench":
        return _refused(parser_for(rest[0]), rest[1:]) if rest[0] in BENCHES else "no bench"
    if started.startswith("tests.") and not rest:
        return "" if (ROOT / f"{started.replace('.', '/')}.py").exists() else "no such module"
    module = _LAUNCHED.get(started)
    return "nothing that can be started" if module is None else _refused(parser_of(module), rest)


def _refused(parser: argparse.ArgumentParser, given: list[str]) -> str:
    try:
        arguments = parser.parse_args(given)
    except SystemExit as ended:
        return "" if not ended.code else f"its own parser refuses {given}"
    with suppress(UsageError):  # a page's folders are not here
        if isinstance(parser, Parser):
            parser.check_outputs(arguments)
    return ""


@pytest.mark.parametrize("page", [page for page in PAGES if page.suffix == ".md"], ids=lambda page: page.stem)
def test_lines_of_code_blocks_are_read_by_their_programs(page: Path) -> None:
    lines = block_lines(page.read_text(encoding="utf-8"))
    assert [f"{shlex.join(words)}: {wrong}" for words in lines if (wrong := wrong_with(words))] == []


def test_faulty_command_lines_are_detected() -> None:
    text = """
    head$  KEY=a v2v-serve --videos DIR \\
        --workers 8   # and so on
    torchrun --nproc-per-node 2 -m trainer.train e2vid --connect A
"""
    serve, train = block_lines(text)
    assert serve == ["v2v-serve", "--videos", "DIR", "--workers", "8"]
    assert wrong_with(serve) == wrong_with(train) == ""
    for line in (
        "v2v-serve --videos DIR --workers many", "v2v-serve --video DIR", "v2v-service", "make tests",
        "python -m bench nothing", "python -m bench chaos --minute 1", "torchrun -m trainer.train e2vid --conect A",
        "python -m bench.nothing", "uvx --from '.[server]' v2v-preview my.mp4", "pip install '.[servers]'",
        "pytest tests/none.py",
    ):  # fmt: skip
        assert wrong_with(shlex.split(line)), line


BARE = re.compile(r"`(--[a-z][a-z-]*)(?![a-z_-])[^`]*`")
PROGRAM = re.compile(r"`(v2v-[a-z]+)[ `]")

OF_OTHERS = {"--constraint": "pip", "--profile": "docker compose", "--standalone": "torchrun", "--shm-size": "docker"}


@pytest.mark.parametrize("page", [page for page in PAGES if page.suffix == ".md"], ids=lambda page: page.stem)
def test_programs_and_flags_named_in_prose_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert set(PROGRAM.findall(text)) <= {*MODULES, "v2v-stream", "v2v-workers"}
    named = set(BARE.findall(text)) - set(OF_OTHERS)
    parsers = [*map(parser_of, (*MODULES.values(), *_MODES.values())), *map(parser_for, BENCHES)]
    assert named <= {flag for parser in parsers for flag in parser._option_string_actions}
