"""What `v2v-serve` can be told, as one frozen, validated dataclass: from a YAML file, from flags, or from both (a flag
wins). Every message names the flag."""

from __future__ import annotations

import dataclasses
import difflib
import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.video.rows import Rows

DEFAULT_BIND = "tcp://127.0.0.1:5555"


@dataclass(frozen=True, slots=True)
class ServeConfig:
    """Settings of one server. Flags are these names with dashes; keys of a YAML file are these names with either.

    Attributes:
        videos: folder tree, single video, or list file.
        workers: local worker processes.
        expect_workers: workers that are expected to serve in all, this host's and others': a consumer's credit is
            settled for as many when it connects. 0, or fewer than there are: for the local ones, or those there are.
        list: list file that restricts a folder.
        rows: rows of each picture that may be used.
        bind: address for consumers.
        worker_bind: address for workers; empty: a private one on this host.
        insecure: allow addresses other than loopback although nothing is encrypted or authenticated.
        port_file: file that receives the bound address once the server is ready.
        cache_dir: folder of the catalogue index; empty: the user's cache.
        list_refused: name every video that cannot be used at the start, not only the first five.
        preset: speed preset ("exact", "balanced", "fast"), see :data:`v2v_protocol.spec.SPEED_PRESETS`.
        recipe: recipe preset name, or a mapping of recipe fields: the default for consumers that ask for none.
        voxel_dtype, shuffle, max_sequences_per_video, on_bad_video, samples_per_decode, sibling_spacing,
            flow_method, flow_direction, flow_from, flow_margin_px, scene: defaults of the other spec fields, see
            :class:`v2v_protocol.spec.StreamSpec`.
        lease_deadline_seconds: a worker silent for longer over one sample is taken for hung.
        session_idle_seconds: a consumer silent for longer is forgotten (it can come back).
        max_credit_bytes: bound on the bytes in flight to one consumer.
        parent_pid: stop when this process is no longer the parent; 0: never mind.

    Raises:
        UsageError: an unknown key, a value of the wrong kind or outside its limits.
    """

    videos: str = ""
    workers: int = 2
    expect_workers: int = 0
    list: str = ""
    rows: str = "full"
    bind: str = DEFAULT_BIND
    worker_bind: str = ""
    insecure: bool = False
    port_file: str = ""
    cache_dir: str = ""
    list_refused: bool = False
    preset: str = "exact"
    recipe: Any = None
    voxel_dtype: str = "int8"
    shuffle: bool = True
    max_sequences_per_video: int = 10
    on_bad_video: str = "substitute"
    samples_per_decode: int | None = None
    sibling_spacing: int | None = None
    flow_method: str = "auto"
    flow_direction: str = "forward"
    flow_from: int = 0
    flow_margin_px: int = 64
    scene: str = "off"
    lease_deadline_seconds: float = 60.0
    session_idle_seconds: float = 600.0
    max_credit_bytes: int = 2 << 30
    parent_pid: int = 0
    spec: StreamSpec = field(init=False, compare=False)

    def __post_init__(self) -> None:
        if not self.videos:
            raise UsageError("--videos is missing: give a folder of videos, one video, or a list file")
        _whole("--workers", self.workers, 0, 4096)
        _whole("--expect-workers", self.expect_workers, 0, 4096)
        _positive("--lease-deadline-seconds", self.lease_deadline_seconds)
        _positive("--session-idle-seconds", self.session_idle_seconds)
        _whole("--max-credit-bytes", self.max_credit_bytes, 1, 1 << 40)
        Rows.parse(self.rows)
        for flag, address in (("--bind", self.bind), ("--worker-bind", self.worker_bind)):
            _check_address(flag, address, self.insecure)
        names = ["preset", *(item.name for item in dataclasses.fields(StreamSpec))]
        spec = StreamSpec.from_dict({name: getattr(self, name) for name in names})
        object.__setattr__(self, "spec", spec)

    @classmethod
    def load(cls, file: str | None, flags: Mapping[str, Any], settings: Sequence[str] = ()) -> ServeConfig:
        """The configuration from an optional YAML file and the flags that were given (None: not given).

        Args:
            file: the YAML file.
            flags: by the names of the attributes.
            settings: of `--set`, to change single fields of the recipe.

        Raises:
            UsageError: the file cannot be read, it has a key twice, or see the class.
        """
        values: dict[str, Any] = {}
        for key, value in ({} if file is None else read_yaml_mapping("--config", file)).items():
            # Who copies a flag writes it as the flag is written.
            name = key.replace("-", "_")
            if name in values:
                raise UsageError(f"--config {file}: {name} is there twice, with dashes and with underscores; keep one")
            values[name] = value
        values |= {name: value for name, value in flags.items() if value is not None}
        known = {item.name: item for item in dataclasses.fields(cls) if item.init}
        for key, value in values.items():
            if key not in known:
                close = difflib.get_close_matches(key, known, n=1)
                hint = f" (did you mean {close[0]!r}?)" if close else ""
                raise UsageError(f"--config {file}: unknown key {key!r}{hint}; known: {', '.join(known)}")
            kind = {"str": str, "int": int, "bool": bool}.get(str(known[key].type))
            if kind is not None and (not isinstance(value, kind) or (kind is int and isinstance(value, bool))):
                said = f"--{key.replace('_', '-')} = {value!r}: expected a value of kind {kind.__name__}"
                # scene: off, say, of which the message would show nothing that was written.
                bare = kind is str and isinstance(value, bool)
                raise UsageError(
                    f"{said} (YAML reads off, on, no and yes as truth values: put it in quotes)" if bare else said
                )
        if settings:
            values["recipe"] = recipe_setting(None, settings, values.get("recipe"))
        return cls(**values)


def recipe_setting(recipe: str | None, settings: Sequence[str], configured: Any = None) -> Any:
    """What `--recipe` and any number of `--set KEY=VALUE` ask for together.

    Args:
        recipe: a preset's name, a YAML file of recipe fields (it may name its ``preset``), or None.
        settings: "key=value" texts, values in YAML ("[0.2, 0.5]", "true", "3").
        configured: what a configuration file says instead of ``recipe``: a preset's name or a mapping of fields.

    Returns:
        None when nothing was asked, else something ``StreamSpec.from_dict`` takes as ``recipe``.

    Raises:
        UsageError: the file cannot be read, or a setting is not "key=value".
    """
    if recipe is None and not settings:
        return None
    fields: dict[str, Any] = {}
    if recipe is not None:
        is_file = recipe.endswith((".yaml", ".yml"))
        fields = read_yaml_mapping("--recipe", recipe) if is_file else {"preset": recipe}
    elif configured is not None:
        fields = dict(configured) if isinstance(configured, Mapping) else {"preset": configured}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise UsageError(f"--set {setting}: write KEY=VALUE, for instance --set voxels_per_clip=5")
        try:
            fields[key.strip()] = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError) as error:  # ValueError: a date that does not exist
            raise UsageError(f"--set {setting}: {text!r} is not a value") from error
    return Recipe.from_dict(fields)


def read_yaml_mapping(flag: str, file: str) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        UsageError: it cannot be read, has a key twice, or holds something else; the message names the flag.
    """
    try:
        values = yaml.load(Path(file).read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise UsageError(f"{flag} {file}: {error.strerror}") from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, or a date that does not exist
        raise UsageError(f"{flag} {file}: not YAML: {' '.join(str(error).split())[:200]}") from error
    if values is None:
        return {}
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise UsageError(f"{flag} {file}: expected keys and values, found {type(values).__name__}")
    return values


class _Loader(yaml.SafeLoader):
    """Refuses a mapping that has a key twice, of which SafeLoader would take the last without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # no key of ours
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is there twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _check_address(flag: str, address: str, insecure: bool) -> None:
    if not address and flag == "--worker-bind":
        return
    scheme, separator, rest = address.partition("://")
    if not separator or scheme not in ("tcp", "ipc") or not rest:
        raise UsageError(f"{flag} {address!r}: write tcp://HOST:PORT (PORT may be *) or ipc://PATH")
    if scheme == "ipc":
        return
    host, colon, port = rest.rpartition(":")
    is_number = port.isascii() and port.isdecimal()
    if not colon or not host or not (port in ("*", "0") or (is_number and 0 < int(port) < 65536)):
        raise UsageError(f"{flag} {address!r}: write tcp://HOST:PORT with a port from 1 to 65535, or * for a free one")
    if not insecure and not _is_loopback(host[1:-1] if host[0] == "[" and host[-1] == "]" else host):
        raise UsageError(
            f"{flag} {address} is reachable from other machines, and nothing is encrypted or authenticated: "
            f"bind to 127.0.0.1, or type out --insecure if everyone on that network may use this server"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _whole(flag: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise UsageError(f"{flag} {value}: give a whole number from {low} to {high}")


def _positive(flag: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise UsageError(f"{flag} {value}: give a positive number of seconds")
