"""The stream as a PyTorch dataset."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch.distributed
from torch.utils.data import IterableDataset, get_worker_info

from v2v_client.batch import Batch
from v2v_client.connection import Connection
from v2v_client.delivery import deliver
from v2v_client.liveness import Patience
from v2v_client.options import Options
from v2v_client.progress import Progress
from v2v_client.state import LoaderShare, ResumeState, Stream
from v2v_client.world import EpochPlan, resumed
from v2v_protocol.errors import StateMismatch, UsageError
from v2v_protocol.messages import Hello
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import LARGEST_EPOCH, LARGEST_SEED

_NO_BATCH_YET = 0
_NOT_SHARED = (
    "samples of one decode go to different ranks or loader workers here, so each is decoded for itself: the stream was "
    "begun with another batch size, world size or number of loader workers. Its samples are the same all the same"
)


@dataclass(frozen=True, slots=True)
class _Loader:
    """The loader worker this process is; ``number`` is which start of the iteration it is."""

    worker: int
    workers: int
    iteration: str
    number: int


class V2VStreamDataset(IterableDataset[Batch]):
    """Whole batches of freshly simulated event-camera clips, from a v2v server.

        for batch in V2VStreamDataset("tcp://127.0.0.1:5555", batch_size=12):
            batch.voxels  # int8 [B, T, bins, H, W]

    Iterate it directly, or through ``DataLoader(dataset, batch_size=None, num_workers=..., pin_memory=...)``. Each
    loader worker opens a connection of its own and takes every num_workers-th batch; the batches and their order are
    the same however many there are.

    One iteration is one epoch from its beginning. Finishing it advances the epoch; leaving it early and iterating again
    repeats it. After :meth:`load_state_dict` an iteration begins where the state was taken. Ranks get disjoint samples
    and equally many batches; what does not fill a global batch at the end of an epoch is dropped.

    With loader workers, an epoch counts as finished once every worker has delivered its share, which is a few
    prefetched batches before the training loop sees the last one. A loop that may leave that early calls
    :meth:`set_epoch` before each iteration; with ``persistent_workers`` it always should.

    Args:
        address: of the server, ``tcp://host:port``.
        batch_size: samples of one rank's batch.
        arrays: which of "voxels" and "frames" to receive. It never changes what they hold.
        recipe: the virtual cameras: name of a preset, a mapping of fields, or a Recipe; None takes the server's.
        seed: of all random draws and of the order.
        epoch: the first one.
        rank, world_size: those of torch.distributed when it is initialised, else 0 and 1.
        preset: speed against accuracy: "exact", "balanced" or "fast" (:data:`v2v_protocol.spec.SPEED_PRESETS`); the
            options below may change what it sets.
        voxel_dtype, shuffle, max_sequences_per_video, on_bad_video, loop_filter, samples_per_decode, sibling_spacing,
            flow_*, scene: see :class:`v2v_protocol.spec.StreamSpec`; None takes the server's.
        shared_memory: whether server workers on this host may put samples into memory of this process, which saves
            most of what moving them costs; where they cannot, samples come in messages by themselves.
        timeout_seconds: silence after which the server is taken for lost.
        patience: the other times; None for the defaults. Its ``timeout_seconds`` is not used.

    A sample is made once for the position it is asked for; what a crash or a cut swallows is asked for again. So each
    sample comes once relative to the state that was saved, whichever process died in between.

    Memory of an iterating process (each loader worker is one), however slow its trainer, with S bytes in a sample, k
    batches that the trainer itself still holds, and a credit of C samples. The server grants twice ``batch_size``, or
    twice its number of workers if that is more; ``samples_per_decode`` times as much (in whole batches) where siblings
    share a decode; less where ``--max-credit-bytes`` says so.

        received, waiting              C S           (2 C S while everything is asked for again)
        batches being filled and held  (ceil(C / batch_size) + 2 + k) batch_size S
        at the server, not yet sent    C S

    Iterating raises ServerLost (nothing heard for ``timeout_seconds``), RemoteError (the server refuses),
    SampleUnavailable (a sample cannot be made), StateMismatch (the server offers another stream than the one begun),
    ProtocolError (it is no v2v server), UsageError (the epoch holds no whole global batch). From a loader worker,
    PyTorch turns RemoteError and SampleUnavailable into RuntimeError with the same text.

    Raises:
        UsageError: an argument outside its range.
    """

    def __init__(
        self,
        address: str,
        batch_size: int = 12,
        arrays: Sequence[str] = ("voxels", "frames"),
        recipe: str | Mapping[str, Any] | Recipe | None = None,
        seed: int = 0,
        epoch: int = 0,
        rank: int | None = None,
        world_size: int | None = None,
        preset: str | None = None,
        voxel_dtype: str | None = None,
        shuffle: bool | None = None,
        max_sequences_per_video: int | None = None,
        on_bad_video: str | None = None,
        loop_filter: str | None = None,
        samples_per_decode: int | None = None,
        sibling_spacing: int | None = None,
        flow_method: str | None = None,
        flow_direction: str | None = None,
        flow_from: int | None = None,
        flow_margin_px: int | None = None,
        scene: str | None = None,
        shared_memory: bool = True,
        timeout_seconds: float = 60.0,
        patience: Patience | None = None,
    ) -> None:
        super().__init__()
        if (rank is None) != (world_size is None):
            raise UsageError(f"rank = {rank}, world_size = {world_size}: give both or none")
        self._address = address
        self._batch_size = _whole("batch_size", batch_size, 1, 65_536)
        self._arrays = (arrays,) if isinstance(arrays, str) else tuple(arrays)
        self._seed = _whole("seed", seed, 0, LARGEST_SEED)
        self._options = Options(
            self._arrays,
            preset=preset,
            recipe=recipe,
            voxel_dtype=voxel_dtype,
            shuffle=shuffle,
            max_sequences_per_video=max_sequences_per_video,
            on_bad_video=on_bad_video,
            loop_filter=loop_filter,
            samples_per_decode=samples_per_decode,
            sibling_spacing=sibling_spacing,
            flow_method=flow_method,
            flow_direction=flow_direction,
            flow_from=flow_from,
            flow_margin_px=flow_margin_px,
            scene=scene,
        )
        self._patience = dataclasses.replace(patience or Patience(), timeout_seconds=timeout_seconds)
        self._shared_memory = shared_memory
        self._explicit = None if rank is None or world_size is None else (rank, world_size)
        self._ambient = _distributed() or (0, 1)
        self._progress = Progress(_whole("epoch", epoch, 0, LARGEST_EPOCH))
        self._iterations = 0
        self._here: ResumeState | None = None  # after the last batch of this process; None where the log says
        self._loaded: ResumeState | None = None  # of this loader worker, from a stateful loader
        EpochPlan(0, self.world_size, self.rank, self._batch_size)

    def __getstate__(self) -> dict[str, Any]:
        # A spawned loader worker knows nothing of the process group.
        return self.__dict__ | {"_ambient": _distributed() or self._ambient}

    # --- what it is ---------------------------------------------------------------------------------------------------

    @property
    def rank(self) -> int:
        """Which of the ranks this is."""
        return (self._explicit or _distributed() or self._ambient)[0]

    @property
    def world_size(self) -> int:
        """How many ranks share an epoch."""
        return (self._explicit or _distributed() or self._ambient)[1]

    @property
    def epoch(self) -> int:
        """The epoch that the next iteration delivers."""
        return self._progress.standing().epoch

    @property
    def stream(self) -> Stream | None:
        """What the samples are made of: resolved spec, digests, sequences per epoch; None before the first Welcome."""
        return self._progress.standing().stream

    def describe(self) -> dict[str, Any]:
        """The stream and this consumer's part in it as plain values, for a log.

        Raises:
            UsageError: nothing is known yet: no connection was opened.
        """
        stream = self.stream
        if stream is None:
            raise UsageError(f"{self._address} has not been asked yet: iterate first")
        return {field.name: getattr(stream, field.name) for field in dataclasses.fields(Stream)} | {
            "address": self._address,
            "arrays": list(self._arrays),
            "batch_size": self._batch_size,
            "seed": self._seed,
            "rank": self.rank,
            "world_size": self.world_size,
        }

    def __len__(self) -> int:
        """Batches of the next iteration.

        Raises:
            TypeError: not known before the first Welcome (or a loaded state): a guess would make a DataLoader lie.
        """
        standing = self._progress.standing()
        if standing.stream is None:
            raise TypeError("the number of batches is known once the server has answered: iterate first")
        return self._plan(standing.stream, standing.state).batches

    # --- position -----------------------------------------------------------------------------------------------------

    def set_epoch(self, epoch: int) -> None:
        """The next iteration delivers ``epoch``; from its beginning, unless a state of that epoch was loaded."""
        standing = self._progress.standing()
        same = standing.epoch == _whole("epoch", epoch, 0, LARGEST_EPOCH)
        self._progress.set(epoch, standing.state if same else None)
        self._here = None

    def state_dict(self) -> dict[str, Any]:
        """The position after the last batch that this process took.

        In a loader worker, the state is that of the worker, as ``torchdata.stateful_dataloader`` wants it.

        Raises:
            UsageError: loader workers took the batches, so that this process does not know.
        """
        if self._here is not None and get_worker_info() is not None:
            return self._here.to_dict()
        standing = self._progress.standing()
        if standing.stale:
            raise UsageError(
                "state_dict: the batches went through DataLoader workers, and this process does not know which of them "
                "were used; save Batch.resume_state of the last batch you trained on instead"
            )
        return (self._here or standing.state or self._beginning(standing)).to_dict()

    def _beginning(self, standing: Any) -> ResumeState:
        return ResumeState(standing.stream, self._seed, standing.epoch, 0, 0, self.world_size)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The next iteration begins where ``state`` was taken.

        Args:
            state: of :meth:`state_dict` or ``Batch.resume_state``; of any batch size, number of loader workers and
                (for a rank's state) world size.

        Raises:
            StateMismatch: it belongs to another seed or spec.
            UsageError: not a state, or that of a loader worker somewhere else.
        """
        loaded = ResumeState.from_dict(state)
        if loaded.seed != self._seed:
            raise StateMismatch(
                f"seed: the state has {loaded.seed}, this dataset {self._seed}; give seed={loaded.seed}"
            )
        if loaded.stream is not None:
            self._options.spec(loaded.stream, "the state")
        loader = get_worker_info()
        if loaded.share is not None:
            self._require_share(loaded, loader)
        origin, position = resumed(
            origin=loaded.origin,
            position=loaded.position,
            saved_world_size=loaded.world_size,
            world_size=self.world_size,
        )
        loaded = dataclasses.replace(loaded, origin=origin, position=position, world_size=self.world_size)
        begun = loaded.position + loaded.origin > 0
        if begun and loaded.stream is not None and self._plan(loaded.stream, loaded).batches == 0:
            # Nothing but what an epoch drops is left of this one.
            loaded = dataclasses.replace(loaded, epoch=loaded.epoch + 1, origin=0, position=0, share=None)
        shared = dataclasses.replace(loaded, share=None)
        if loader is None:
            self._progress.set(loaded.epoch, shared)
        else:
            self._progress.set(loaded.epoch, shared, iteration=self._iteration(loader))
            self._loaded = loaded
        self._here = loaded

    def _require_share(self, state: ResumeState, loader: Any) -> None:
        share = state.share
        here = None if loader is None else (loader.id, loader.num_workers, self._batch_size, self.world_size)
        if share is None or here == (share.worker, share.workers, share.batch_size, state.world_size):
            return
        raise UsageError(
            f"this is the state of loader worker {share.worker} of {share.workers} (batch_size {share.batch_size}, "
            f"world size {state.world_size}); only the same worker of an equal loader can go on from it. "
            "Batch.resume_state holds for any number of loader workers"
        )

    # --- iteration ----------------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Batch]:
        self._iterations += 1
        worker = get_worker_info()
        if worker is None:
            self._progress.main()
            standing = self._progress.standing()
            epoch, state = standing.epoch, standing.state
            self._here = state or self._beginning(standing)
            return self._iterate(epoch, state, None, _NO_BATCH_YET, self._iterations)
        iteration = self._iteration(worker)
        number, epoch, state = self._progress.start(iteration, worker.id)
        loader = _Loader(worker.id, worker.num_workers, iteration, number)
        done = self._already_done(epoch, state)
        known = state.stream if state is not None else None
        if known is not None and self._share_done(known, state, loader, done):
            # A stateful loader may discard this iterator unused; the epoch is over all the same.
            self._finish(epoch, loader)
        else:
            self._here = self._worker_state(self.stream, epoch, state, loader, done)
        return self._iterate(epoch, state, loader, done, self._iterations)

    def _iteration(self, worker: Any) -> str:
        """A name that the loader workers of one iteration share: PyTorch seeds them alike, and they iterate alike."""
        return f"{worker.seed - worker.id}:{self._iterations}"

    def _already_done(self, epoch: int, state: ResumeState | None) -> int:
        """Batches of this loader worker's share that a loaded state says it delivered."""
        loaded = self._loaded
        if loaded is None or loaded.share is None or state is None:
            return _NO_BATCH_YET
        here, there = (loaded.epoch, loaded.origin, loaded.position), (epoch, state.origin, state.position)
        return loaded.share.batches if here == there else _NO_BATCH_YET

    def _share_done(self, stream: Stream, state: ResumeState | None, loader: _Loader, done: int) -> bool:
        share = self._plan(stream, state).batches_of_worker(loader.worker, loader.workers)
        return done > 0 and done >= len(share)

    def _iterate(
        self, epoch: int, state: ResumeState | None, loader: _Loader | None, done: int, mine: int
    ) -> Iterator[Batch]:
        pinned = self.stream
        workers = loader or _Loader(0, 1, "", 0)
        connection = Connection(
            self._address,
            Hello(
                self._options.spec(pinned, "this dataset's stream"),
                self._arrays,
                self._batch_size,
                self._seed,
                quarantine=None if state is None else state.quarantine,
                stride=self._batch_size * self.world_size * workers.workers,
            ),
            epoch,
            pinned=pinned,
            pinned_by="the saved state" if state is not None else "this dataset",
            patience=self._patience,
            shared_memory=self._shared_memory,
        )
        try:
            connection.open()
            stream = connection.stream
            if pinned is None:
                self._progress.pin(stream)
                first = self.stream
                if first is not None:  # a loader worker beside us may have been offered another one
                    first.require_same(stream, ours="another loader worker", theirs=self._address)
            plan = self._plan(stream, state)
            if state is None:
                plan.require_batches()
            if stream.resolved.samples_per_decode > 1 and not plan.shares_decodes(
                stream.resolved.sibling_spacing, workers.workers
            ):
                warnings.warn(_NOT_SHARED, stacklevel=2)
            batches = plan.batches_of_worker(workers.worker, workers.workers)[done:]

            def after(batch: int, quarantine: int) -> dict[str, Any]:
                return self._after(stream, epoch, plan, batch, quarantine).to_dict()

            for batch, number in zip(deliver(connection, plan, batches, epoch, after), batches, strict=True):
                done += 1
                if mine == self._iterations:  # an older iterator that is still read says nothing about where we are
                    seen = batch.resume_state["quarantine"]
                    self._here = (
                        self._after(stream, epoch, plan, number, seen)
                        if loader is None
                        else self._worker_state(stream, epoch, state, loader, done, seen)
                    )
                yield batch
        finally:
            connection.close()
        if mine == self._iterations:
            self._finish(epoch, loader)

    def _finish(self, epoch: int, loader: _Loader | None) -> None:
        if loader is None:
            self._progress.set(epoch + 1, None)
            self._here = None
        else:
            self._progress.finish(loader.iteration, loader.number, loader.worker, loader.workers, epoch)
            self._here = ResumeState(self.stream, self._seed, epoch + 1, 0, 0, self.world_size)

    def _plan(self, stream: Stream, state: ResumeState | None) -> EpochPlan:
        origin, position = (0, 0) if state is None else (state.origin, state.position)
        return EpochPlan(stream.sequences, self.world_size, self.rank, self._batch_size, origin, position)

    def _after(self, stream: Stream, epoch: int, plan: EpochPlan, batch: int, quarantine: int | None) -> ResumeState:
        """The rank's state after a batch; after the last one, that is the beginning of the next epoch."""
        if batch + 1 == plan.batches:
            return ResumeState(stream, self._seed, epoch + 1, 0, 0, plan.world_size)
        position = plan.position_after(batch)
        return ResumeState(stream, self._seed, epoch, plan.origin, position, plan.world_size, quarantine=quarantine)

    def _worker_state(
        self,
        stream: Stream | None,
        epoch: int,
        state: ResumeState | None,
        loader: _Loader,
        done: int,
        quarantine: int | None = None,
    ) -> ResumeState:
        origin, position = (0, 0) if state is None else (state.origin, state.position)
        share = LoaderShare(loader.worker, loader.workers, self._batch_size, done)
        return ResumeState(stream, self._seed, epoch, origin, position, self.world_size, share, quarantine)


def _distributed() -> tuple[int, int] | None:
    """(rank, world size) of the default process group, if there is one."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None


def _whole(name: str, value: Any, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise UsageError(f"{name} = {value!r}: give a whole number from {low} to {high}")
    return value
