"""Which supervisor a server has: by the name of its engine."""

from __future__ import annotations

from importlib import import_module

from v2v_protocol.errors import UsageError
from v2v_server.config import ServeConfig
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.keys.folder import KeyFolder
from v2v_server.supervise.local_pool import Pool
from v2v_server.supervise.protocol import Supervisor


def make_supervisor(
    config: ServeConfig, source: VideoSource, label: str, flags: list[str], keys: KeyFolder | None = None
) -> Supervisor:
    """The supervisor that the configuration asks for.

    Args:
        config: of the server.
        source: where the videos come from; workers open it by its name.
        label: prefix of the workers' names, unique to this server.
        flags: more of them for each worker.
        keys: of the server, which lends one to workers on other hosts.

    Raises:
        UsageError: its engine is not installed, or there is no cluster.
    """
    if config.engine == "local":
        return Pool(source.name, label, flags)
    try:
        engine = import_module("v2v_server.supervise.ray_workers")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UsageError(
            "--engine ray needs the Python package ray, which is not installed; the extra 'ray' brings it: "
            "pip install '.[server,ray]' in a checkout of v2v-stream, here and on every node of the cluster"
        ) from error
    key = None if keys is None else keys.lend(f"ray-{label}", "worker")
    supervisor: Supervisor = engine.RayWorkers(source.name, label, flags, config.ray_address, config.ray_labels, key)
    return supervisor
