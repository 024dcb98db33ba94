"""Check that code which could execute received data is absent, or only in the few places named here."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGES = ("v2v_protocol", "v2v_pictures", "v2v_recordings", "v2v_server", "v2v_tools", "v2v_client", "trainer")
MAY_UNPICKLE = {
    "v2v_client/passes.py",  # a descriptor that only this process and its loader workers have
    "trainer/unpickle.py",  # weights, by an unpickler that knows a closed list of names
}
CALLS = {"eval", "exec", "os.system", "os.popen", "pickle.load", "pickle.loads", "marshal.loads", "yaml.unsafe_load"}


class Call(NamedTuple):
    """A call in a file: the function, its further arguments, and its keywords, as source."""

    path: str
    function: str
    arguments: tuple[str, ...]
    keywords: dict[str | None, str]


def files(pattern: str) -> list[Path]:
    """Return the files of all packages in which the pattern is found."""
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    return [path for path in paths if re.search(pattern, path.read_text("utf-8"), re.MULTILINE)]


def calls(*words: str) -> list[Call]:
    """Return all calls of the files in which one of the words is found: most files need no parsing."""
    found = []
    for path in files("|".join(map(re.escape, words))):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                function, *arguments = map(ast.unparse, (node.func, *node.args[1:]))
                keywords = {word.arg: ast.unparse(word.value) for word in node.keywords}
                found.append(Call(str(path.relative_to(ROOT)), function, tuple(arguments), keywords))
    return found


def test_received_data_is_never_executed() -> None:
    assert {call.path for call in calls(*CALLS) if call.function in CALLS} == {"v2v_client/passes.py"}


def test_no_channel_between_processes_unpickles() -> None:
    channels = ("Pipe", "Queue", "SimpleQueue", "Manager", "Listener", "Pool", "ProcessPoolExecutor", "recv_pyobj")
    ends = tuple(f".{name}" for name in channels)
    assert [
        call
        for call in calls("multiprocessing.")
        if call.function.startswith("multiprocessing.") and call.function.endswith(ends)
    ] == []
    assert {call.path for call in calls("recv_pyobj") if call.function.endswith("recv_pyobj")} == set()


def test_commands_never_use_a_shell() -> None:
    assert [call.path for call in calls("shell") if "shell" in call.keywords] == []


def test_yaml_is_loaded_safely() -> None:
    loaders = ("yaml.load", "yaml.full_load")
    loads = {(call.path, call.arguments[0]) for call in calls(*loaders) if call.function in loaders}
    assert loads == {("v2v_protocol/safe_yaml.py", "_Loader")}
    assert "class _Loader(yaml.SafeLoader)" in (ROOT / "v2v_protocol/safe_yaml.py").read_text(encoding="utf-8")


def test_weights_and_arrays_are_loaded_without_pickle() -> None:
    """``weights_only=False`` is there once, with an unpickler of a closed list instead of pickle."""
    unsafe = [
        (call.path, word)
        for call in calls("allow_pickle", "weights_only")
        for word, safe in (("allow_pickle", "False"), ("weights_only", "True"))
        if call.keywords.get(word, safe) != safe
    ]
    assert unsafe == [("trainer/unpickle.py", "weights_only")]
    loads = [call.keywords for call in calls("torch.load") if call.function == "torch.load"]
    assert loads
    for keywords in loads:
        assert keywords["weights_only"] == "True" or keywords["pickle_module"] == "_TENSORS_ONLY"


def test_opencv_opens_no_file() -> None:
    readers = ("VideoCapture", "imread", "imreadmulti", "FileStorage", "readNet")
    assert [call.path for call in calls(*readers) if call.function.endswith(readers)] == []


def test_pickle_is_used_in_two_places() -> None:
    found = files(r"^\s*(import|from)\b.*\bpickle\b")
    assert {str(path.relative_to(ROOT)) for path in found} == MAY_UNPICKLE
