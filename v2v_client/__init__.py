"""The consumer's side: a PyTorch dataset that receives finished batches from a v2v server.

from v2v_client import V2VStreamDataset

for batch in V2VStreamDataset("tcp://127.0.0.1:5555", batch_size=12):
    batch.voxels  # int8 [B, T, bins, H, W]

The rooms:

    dataset     the dataset; its batch, delivery (samples to batches) and ordering; options: what may be asked for
    session/    conversation (pure: states, messages, times), connection (holds it over a link), link (the socket)
    memory/     arena (workers of this host may write there), slots (whose row is whose), buffers (used again)
    position/   plan (which samples are whose), state (what is saved), position (of one copy), shared (of all copies)
    loaders     what loaders and loops of others need; in_process: samples by index, without a server; look: pictures
    tools/      the load test; local_server: a server of one's own
"""

from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.in_process import V2VDataset
from v2v_protocol.allocator import keep_freed_memory
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

__all__ = [
    "Batch",
    "NoWorkers",
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
