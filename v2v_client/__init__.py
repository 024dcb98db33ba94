"""Provide the consumer's side: a PyTorch dataset that receives finished batches from a v2v server.

from v2v_client import V2VStreamDataset

for batch in V2VStreamDataset("tcp://127.0.0.1:5555", batch_size=12):
    batch.voxels  # int8 [B, T, bins, H, W]

Modules:

    dataset       the dataset; batch: what it yields; delivery: samples to batches; options: what a consumer may request
    mixture       the order of the batches of several datasets, pure
    conversation  the protocol, pure (states, messages, times); connection: runs it over a link
    memory        arenas (workers of this host write there), slots (which sample has which row), buffers (reused)
    position      which samples a consumer gets, and the state that is saved; passes: shared with loader workers
    loaders       adjustments for loader workers
    representations  inputs of other networks, from the arrays of a batch
    in_process    samples by index, without a server
    loadtest      the load test; local_server: a server as a subprocess
"""

import sys
from types import ModuleType

from v2v_protocol.programs import name_extra

try:
    from v2v_client import options
    from v2v_client.batch import Batch
    from v2v_client.dataset import V2VStreamDataset
    from v2v_client.in_process import V2VDataset
    from v2v_client.options import Patience
except ModuleNotFoundError as error:
    if (missing := error.name or "").startswith("v2v_"):
        raise
    raise ModuleNotFoundError(name_extra("v2v_client", missing, "client"), name=missing) from error
from v2v_protocol.arena import keep_freed_memory
from v2v_protocol.errors import (
    NoWorkers,
    ProtocolError,
    RecipeError,
    RemoteError,
    RepeatedSamplesWarning,
    SampleUnavailable,
    ServerLost,
    StateMismatch,
    UsageError,
    V2VError,
    VersionMismatch,
)

# Where Patience was in release 0.2.0. Python asks for a module's package first.
session = ModuleType("v2v_client.session")
vars(session)["liveness"] = options
sys.modules |= {"v2v_client.session": session, "v2v_client.session.liveness": options}

__all__ = [
    "Batch",
    "NoWorkers",
    "Patience",
    "ProtocolError",
    "RecipeError",
    "RemoteError",
    "RepeatedSamplesWarning",
    "SampleUnavailable",
    "ServerLost",
    "StateMismatch",
    "UsageError",
    "V2VDataset",
    "V2VError",
    "V2VStreamDataset",
    "VersionMismatch",
    "keep_freed_memory",
]
