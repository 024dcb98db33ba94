"""Settings of `v2v-serve`, as one frozen, validated dataclass: from a YAML file, from flags, or from both (a flag
wins). Every message names the flag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from v2v_protocol.command import flag_of
from v2v_protocol.errors import UsageError
from v2v_protocol.keys import is_loopback
from v2v_protocol.recipe import STREAM_PRESETS
from v2v_protocol.settings import bounds, check_settings, number, require_known, settings_of, switch, text, whole, word
from v2v_protocol.spec import SPEC_KEYS, StreamSpec
from v2v_protocol.spec_flags import read_recipe, read_yaml_mapping, recipe_setting
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, KindFlags, kind_from
from v2v_server.system.log import LOG_FORMATS
from v2v_server.video.rows import Rows

DEFAULT_BIND = "tcp://127.0.0.1:5555"
MOST_WORKERS = 4096
ENGINES = {"local": "v2v_server.supervise.local_host", "ray": "v2v_server.supervise.ray_host"}
"""Where workers can run: the module of each :class:`v2v_server.supervise.pool.Host`."""


@dataclass(frozen=True, slots=True)
class ServeConfig:
    """Settings of one server. Flags are these names with dashes; keys of a YAML file are these names with either.

    Attributes:
        kind: what a video is. Its fields, and those of ``spec``, are flags and keys like the others.
        spec: the default for consumers that request nothing else.

    Raises:
        UsageError: an unknown key, a value of the wrong kind or outside its limits.
    """

    videos: str = text(
        "",
        "folder of videos (searched recursively), a video, a list file, or s3://bucket/prefix (extra cloud)",
        metavar="DIR",
        group="Videos",
    )
    list: str = text("", "list file (path frames c+ c-) that restricts the videos", metavar="FILE")
    rows: str = text("full", "rows of each picture to use: full, top:0.54 (WebVid), top:180px, 0.1:0.6", metavar="ROWS")
    cache_dir: str = text(
        "", "folder of the catalogue index and the quarantine (default: the user's cache folder)", metavar="DIR"
    )
    cache: str = text(
        "",
        "folder that caches decoded frames for later epochs; servers may share it",
        metavar="DIR",
    )
    cache_gib: float = number(100.0, 0.0, 1e6, "size limit of --cache", unit="GiB", metavar="N")
    copies: str = text(
        "", "folder for videos fetched from object storage (default: in the user's cache folder)", metavar="DIR"
    )
    copies_gib: float = number(
        100.0, 0.001, 1e6, "size limit of --copies; the least recently read files are deleted first", unit="GiB",
        metavar="N",
    )  # fmt: skip
    list_refused: bool = switch(False, "at the start, list every unusable video instead of the first five")
    workers: tuple[int, int] = bounds(
        (2, 2), 0, MOST_WORKERS,
        "number of worker processes that the server starts, and restarts if they die; with LEAST:MOST the server "
        "adjusts the number so that consumers do not wait",
        group="Workers",
    )  # fmt: skip
    scale_seconds: float = number(
        60.0, 0.1, 1e6,
        "with LEAST:MOST: time after which idle workers are stopped; workers are added after consumers waited for a "
        "sixth of it",
        unit="s", metavar="S",
    )  # fmt: skip
    engine: str = word(
        "local",
        ENGINES,
        "where workers run: local is this host, ray is a Ray cluster that this host belongs to",
    )
    ray_address: str = text("auto", "address of the Ray cluster; auto: the cluster of this host", metavar="HOST:PORT")
    ray_label: str = text(
        "", "start workers only on Ray nodes with this label: those that have the videos", metavar="KEY=VALUE"
    )
    expect_workers: int = whole(
        0, 0, MOST_WORKERS,
        "total number of workers expected, including other hosts; sets how many samples each consumer may request "
        "ahead, up to 400 and --max-credit-bytes. 0: the local workers, or those connected",
    )  # fmt: skip
    lease_deadline_seconds: float = number(
        60.0, 0.001, 1e6, "a worker that is silent over one sample for longer is treated as hung", unit="s", metavar="S"
    )
    bind: str = text(
        DEFAULT_BIND,
        "address for consumers; port * chooses a free port",
        metavar="ADDRESS",
        group="Addresses and consumers",
    )
    worker_bind: str = text("", "address for workers (default: an address private to this host)", metavar="ADDRESS")
    keys: str = text(
        "",
        "folder that v2v-keys init made: tcp addresses then accept only its keys, and all traffic is encrypted",
        metavar="DIR",
    )
    insecure: bool = switch(
        False, "serve every user of this host, and allow addresses that other machines can reach, without keys"
    )
    port_file: str = text("", "file that the bound address is written to once the server is ready", metavar="FILE")
    max_credit_bytes: int = whole(2 << 30, 1, 1 << 40, "largest number of bytes in flight to one consumer")
    share_gib: float = number(
        0.0, 0.0, 1e6,
        "memory for finished samples: each is made once for all consumers that request equal ones; 0: off",
        unit="GiB", metavar="N",
    )  # fmt: skip
    page: int = whole(
        0, 0, 65535, "port of the status page and its metrics; 5580 if no PORT is given, 0: no page",
        bare=5580, metavar="PORT", group="Watching",
    )  # fmt: skip
    page_host: str = text("127.0.0.1", "address of this host that the page listens on", metavar="HOST")
    page_names: str = text(
        "", "comma-separated host names that the page accepts, in addition to IP addresses and this host's name",
        metavar="NAMES",
    )  # fmt: skip
    log_format: str = word(
        "text", LOG_FORMATS, "format of standard error: text for people, or json, one object per line"
    )  # fmt: skip
    parent_pid: int = whole(0, 0, 1 << 31, "stop when this process is no longer the parent; 0: never", is_hidden=True)
    kind: VideosKind = VIDEOS
    spec: StreamSpec = field(default_factory=StreamSpec)

    def __post_init__(self) -> None:
        check_settings(self, flag_of)
        if not self.videos:
            raise UsageError("--videos is missing: give a folder of videos, one video, or a list file")
        Rows.parse(self.rows)
        for flag, address in (("--bind", self.bind), ("--worker-bind", self.worker_bind)):
            _check_address(flag, address, is_safe=bool(self.keys) or self.insecure)
        if self.page and not self.insecure and not is_loopback(self.page_host):
            raise UsageError(
                f"--page-host {self.page_host} can be reached from other machines, and the page requires no key: "
                "listen on 127.0.0.1 and reach it by `ssh -L`, or give --insecure if everyone on that network may "
                "watch this service"
            )
        if self.engine != "local" and not self.worker_bind:
            raise UsageError(
                f"--engine {self.engine}: give the workers of other hosts an address of this one, --worker-bind tcp://HOST:5556"
            )
        if self.ray_label and not all(self.ray_label.partition("=")):
            raise UsageError(f"--ray-label {self.ray_label!r}: write KEY=VALUE, as `ray start --labels KEY=VALUE` does")

    @property
    def least_workers(self) -> int:
        """Smallest number of the server's own workers."""
        return self.workers[0]

    @property
    def most_workers(self) -> int:
        """Largest number of the server's own workers."""
        return self.workers[1]

    @property
    def workers_in_all(self) -> int:
        """Largest number of workers that may serve, including other hosts, as far as is known."""
        return max(self.most_workers, self.expect_workers)

    @property
    def ray_labels(self) -> dict[str, str]:
        """Labels that Ray nodes must have to run workers."""
        key, _, value = self.ray_label.partition("=")
        return {key: value} if key else {}

    @classmethod
    def load(cls, file: str | None, flags: Mapping[str, Any], settings: Sequence[str] = ()) -> ServeConfig:
        """Build the configuration from an optional YAML file and the given flags (None: not given).

        Args:
            file: the YAML file.
            flags: by the names of the attributes, and of the fields of the spec.
            settings: values of `--set`, which change single fields of the recipe.

        Raises:
            UsageError: the file cannot be read, it has a key twice, or see the class.
        """
        values: dict[str, Any] = {}
        for key, value in ({} if file is None else read_yaml_mapping("--config", file)).items():
            # Users who copy a flag write its name with dashes.
            name = key.replace("-", "_")
            if name in values:
                raise UsageError(f"--config {file}: {name} appears twice, with dashes and with underscores; keep one")
            values[name] = value
        require_known(values, SERVE_KEYS, f"key in --config {file}:")
        if asked := STREAM_PRESETS.get(flags.get("preset") or ""):  # a flag wins over the fields that it sets
            values = {name: value for name, value in values.items() if name not in {*asked, "sibling_spacing"}}
        values |= {name: value for name, value in flags.items() if value is not None}
        values |= {"recipe": read_recipe(values["recipe"])} if "recipe" in values else {}
        if settings:
            named = {**STREAM_PRESETS.get(values.get("preset") or "", {}), **values}
            values["recipe"] = recipe_setting(None, settings, named.get("recipe"))
        fields = {name: values.pop(name) for name in SPEC_KEYS if name in values}
        kind = kind_from({name: values.pop(name) for name in settings_of(KindFlags) if name in values})
        config = cls(**values, kind=kind, spec=StreamSpec.from_dict(fields))
        for name, (needed, is_given) in _NEEDS.items():
            if (values | fields).get(name) and not is_given(config):
                raise UsageError(f"{flag_of(name)} has no effect without {needed}; give both, or neither")
        if not config.most_workers and not config.worker_bind:
            raise UsageError(
                "--workers 0: no worker can connect; give --worker-bind tcp://HOST:5556 for those of other hosts, or "
                "at least one worker"
            )
        return config


_NEEDS: Mapping[str, tuple[str, Callable[[ServeConfig], object]]] = {
    "cache_gib": ("--cache DIR", lambda it: it.cache),
    "keep_defects": ("--scene auto", lambda it: it.spec.scene != "off"),
    "page_host": ("--page", lambda it: it.page),
    "page_names": ("--page", lambda it: it.page),
    "scale_seconds": ("--workers LEAST:MOST", lambda it: it.least_workers < it.most_workers),
    "ray_address": ("--engine ray", lambda it: it.engine == "ray"),
    "ray_label": ("--engine ray", lambda it: it.engine == "ray"),
}
"""Settings that need another one: its flag, and whether it is given."""


SERVE_KEYS = (*settings_of(ServeConfig), *settings_of(KindFlags), *SPEC_KEYS)
"""Keys of a YAML file for ``v2v-serve --config``."""


def _check_address(flag: str, address: str, *, is_safe: bool) -> None:
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
    if not is_safe and not is_loopback(host[1:-1] if host[0] == "[" and host[-1] == "]" else host):
        raise UsageError(
            f"{flag} {address} is reachable from other machines, without encryption or authentication: "
            f"bind to 127.0.0.1, give --keys DIR (v2v-keys init creates it), or give --insecure if everyone on that "
            "network may use this server"
        )
