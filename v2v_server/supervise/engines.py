"""Make the pool of workers on the host that the configuration names."""

from __future__ import annotations

from importlib import import_module

from v2v_protocol.errors import UsageError
from v2v_server.config import ENGINES, ServeConfig
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.keys.folder import KeyFolder
from v2v_server.supervise.pool import Pool
from v2v_server.supervise.standby import Standby


def make_pool(
    config: ServeConfig,
    source: VideoSource,
    label: str,
    flags: list[str],
    keys: KeyFolder | None = None,
    standbys: list[Standby] | None = None,
) -> Pool:
    """Return the pool that the configuration asks for.

    Args:
        config: of the server.
        source: where the videos come from; workers open it by its name.
        label: prefix of the workers' names, unique to this server.
        flags: further flags of each worker.
        keys: keys of the server, which lends one to workers on other hosts.
        standbys: workers of this host that are started already; the pool takes them from the list.

    Raises:
        UsageError: the engine is not installed, or there is no cluster.
    """
    name = config.engine
    try:
        engine = import_module(ENGINES[name])
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise UsageError(
            f"--engine {name} needs the Python package {name}, which is not installed; the extra '{name}' brings it: "
            f"pip install '.[server,{name}]' in a checkout of v2v-stream, here and on every node of the cluster"
        ) from error
    key = None if keys is None or name == "local" else keys.lend(f"{name}-{label}", "worker")
    return Pool(engine.make_host(config, source.name, label, flags, key, [] if standbys is None else standbys), label)
