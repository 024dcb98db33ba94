"""Provide the stream as a PyTorch dataset."""

from __future__ import annotations

import copy
import dataclasses
import functools
import os
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import Any, Never, Self

import numpy as np
from torch.utils.data import IterableDataset, get_worker_info

from v2v_client.batch import Batch
from v2v_client.connection import Connection, Connector
from v2v_client.delivery import deliver
from v2v_client.loaders import distributed_rank, end_with_parent, send_before_exit
from v2v_client.local_server import LocalServer, server_flags
from v2v_client.memory import BatchBuffers
from v2v_client.mixture import MixtureConsumer, read_weights
from v2v_client.options import Fixed, Labels, Options, Patience, check_labels, require_arguments, require_labels
from v2v_client.passes import Iteration, Position
from v2v_client.position import Consumer, EpochPlan, ResumeState, StreamIdentity
from v2v_protocol.errors import RepeatedSamplesWarning, StateMismatch, UsageError, undo_on_error
from v2v_protocol.keys import addresses, leaves_host
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import LARGEST_EPOCH, LARGEST_INDEX, LARGEST_SEED, html_table
from v2v_protocol.settings import format_value, require_whole
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import read_recipe

_NOT_SHARED = (
    "samples of one decode go to different ranks or loader workers here, so each is decoded separately: the stream was "
    "begun with another batch size, world size or number of loader workers. The samples do not change"
)


class V2VStreamDataset(Fixed, IterableDataset[Batch]):
    """Stream batches of freshly simulated event-camera clips from a v2v server.

        for batch in V2VStreamDataset("tcp://127.0.0.1:5555", batch_size=12):
            batch.voxels  # int8 [B, T, bins, H, W]

    Iterate it directly, or through ``DataLoader(dataset, batch_size=None, num_workers=..., pin_memory=...)``. Each
    loader worker opens its own connection and takes every num_workers-th batch. The batches and their order do not
    depend on the number of loader workers. Do not use ``in_order=False``: it changes the order and makes every state
    wrong, because the state of a batch counts all earlier batches of the epoch as delivered.

    One iteration is one epoch from its beginning. Finishing it advances the epoch. Leaving it early and iterating again
    repeats it. A RepeatedSamplesWarning says so once: at the second iteration, or at the third if a single batch was
    taken to inspect it (with loader workers, also if they made no more batches than they prefetch). After
    :meth:`load_state_dict` an iteration begins where the state was taken. Ranks get disjoint samples and equally many
    batches. Samples that do not fill a global batch at the end of an epoch are dropped.

    Without loader workers, an iteration begins with its first batch: an epoch set or a state loaded before that counts.

    With loader workers, an epoch counts as finished once every worker has delivered its share, which is a few
    prefetched batches before the training loop sees the last one. A loop that may leave an epoch during these batches
    must call :meth:`set_epoch` before each iteration. With ``persistent_workers``, always call it.

    Args:
        address: the server's ``tcp://host:port``, or those of several servers of the same videos, as a list or
            separated by commas. Each rank uses its own server (:mod:`v2v_client.connection`). If that one is lost,
            it continues with another: no sample is lost or repeated.
        batch_size: samples in one rank's batch.
        arrays: names in ``v2v_protocol.sample.ARRAYS`` to receive. The choice does not affect their content.
        recipe: the virtual cameras: name of a recipe, a mapping of fields, or a Recipe; None takes the server's.
        seed: determines all random draws and the order of the samples.
        epoch: the first epoch.
        rank: rank of this process; None: that of torch.distributed if it is initialised, else 0.
        world_size: number of ranks that share an epoch; None: that of torch.distributed, else 1.
        shared_memory: whether server workers on this host may write samples into memory of this process, which saves
            most of the cost of moving them. Workers that cannot do so send samples in messages.
        labels: "required" raises SampleUnavailable for a sample without the boxes or masks that ``arrays`` requests;
            "optional" delivers it (``batch.labelled``).
        compress: whether samples are compressed for transport, which costs a server worker about 5 % of its time;
            None: only if the server is on another host.
        keys: path of this consumer's key file, see `v2v-keys`; None uses the file that ``V2V_KEYS`` names, which ranks
            and loader workers inherit; "" uses no key.
        insecure: without a key, also receive from another user's server on this host; otherwise UsageError is raised.
        timeout_seconds: silence after which the server counts as lost.
        patience: the other timeouts; None for the defaults. Its ``timeout_seconds`` is not used.
        options: ``preset`` ("exact", "balanced", "fast", "natural" or "natural-davis346", see
            :data:`v2v_protocol.recipe.STREAM_PRESETS`) and fields of :class:`v2v_protocol.spec.StreamSpec`, which
            override the preset; None takes the server's.

    Each sample is requested for its position in the order; samples that a crash or disconnect loses are requested
    again. So each sample arrives exactly once relative to the saved state, whichever process died in between.

    The memory of an iterating process (each loader worker is one) does not depend on the trainer's speed. Let S be the
    bytes of a sample, k the batches that the trainer holds, and C the credit in samples. The server grants twice
    ``batch_size``, or twice its number of workers if that is more. If K = ``samples_per_decode`` samples share a
    decode, it grants a seventh more than K (1 + ceil(2 workers / batch_size)) batches. It never grants more than 400
    samples, nor more than its ``--max-credit-bytes`` hold.

        received, waiting              C S           (2 C S while all requests are sent again)
        batches being filled and held  (ceil(C / batch_size) + 2 + k) batch_size S
        at the server, not yet sent    C S
        between iterations             (ceil(C / batch_size) + 2) batch_size S: buffers, kept for the next

    If workers on this host write samples into memory of this process, the first and the third are close to 0.

    Iterating raises ServerLost (nothing received for ``timeout_seconds``), RemoteError (the server refuses), KeyRefused
    (the server does not accept the key), SampleUnavailable (a sample cannot be made), StateMismatch (the server offers
    another stream than the one begun), ProtocolError (the peer is not a v2v server) or UsageError (the epoch is smaller
    than a global batch, or the server belongs to another user). Errors in a loader worker arrive as the same types,
    with the worker's traceback in their text.
    PyTorch raises RuntimeError if a loader worker was killed.

    Raises:
        UsageError: an argument is outside its range.
    """

    def __init__(
        self,
        address: str | Sequence[str],
        batch_size: int = 12,
        arrays: Sequence[str] = ("voxels", "frames"),
        recipe: str | Mapping[str, Any] | Recipe | None = None,
        *,
        seed: int = 0,
        epoch: int = 0,
        rank: int | None = None,
        world_size: int | None = None,
        shared_memory: bool = True,
        labels: Labels = "required",
        compress: bool | None = None,
        keys: str | os.PathLike[str] | None = None,
        insecure: bool = False,
        timeout_seconds: float = 60.0,
        patience: Patience | None = None,
        **options: Any,
    ) -> None:
        super().__init__()
        require_arguments(V2VStreamDataset.__init__, options)
        if (rank is None) != (world_size is None):
            raise UsageError(f"rank = {rank}, world_size = {world_size}: give both or none")
        arrays = (arrays,) if isinstance(arrays, str) else tuple(arrays)
        brokers = addresses(address)
        self._connector = Connector(
            brokers,
            Options(arrays, recipe=recipe, **options),
            arrays,
            require_whole("batch_size", batch_size, 1, 65_536),
            require_whole("seed", seed, 0, LARGEST_SEED),
            compress=any(map(leaves_host, brokers)) if compress is None else bool(compress),
            keys=None if keys is None else os.fspath(keys),
            insecure=insecure,
            patience=dataclasses.replace(patience or Patience(), timeout_seconds=timeout_seconds),
        )
        self._shared_memory = shared_memory
        self._needs_labels = check_labels(labels)
        if rank is not None:
            rank = require_whole("rank", rank, 0, LARGEST_INDEX)
            world_size = require_whole("world_size", world_size, 1, LARGEST_INDEX)
        self._explicit = None if rank is None or world_size is None else (rank, world_size)
        self._ambient = distributed_rank() or (0, 1)
        self._position = Position(seed, require_whole("epoch", epoch, 0, LARGEST_EPOCH))
        self._buffers = BatchBuffers()
        self._offered: StreamIdentity | None = None  # the server's answer to len(), not pinned
        self._stop_server: Callable[[], object] | None = None  # of a dataset that started its server
        self._is_closed = False
        EpochPlan(0, self.world_size, self.rank, batch_size)

    @classmethod
    def local(
        cls,
        videos: str | os.PathLike[str],
        batch_size: int = 12,
        arrays: Sequence[str] = ("voxels", "frames"),
        recipe: str | Mapping[str, Any] | Recipe | None = None,
        *,
        workers: int = 4,
        flags: Sequence[str] = (),
        seed: int = 0,
        labels: Labels = "required",
        **options: Any,
    ) -> V2VStreamDataset:
        """Start a server on this host and return a dataset that streams from it.

            with V2VStreamDataset.local("my-videos/") as dataset:
                for batch in dataset: ...

        The server stops at the end of the with block (:meth:`close`), with the dataset, or with this process, even if
        the process is killed.

        Args:
            videos: folder or list, as for ``v2v-serve --videos``.
            batch_size, arrays, seed, labels, options: as for the dataset.
            recipe: as for the dataset; None: that of ``preset``, or the paper's.
            workers: number of server workers.
            flags: more flags for ``v2v-serve``, for instance ``["--cache", "clips/"]``, or
                ``["--videos-kind", "photographs"]`` with ``preset="worlds"``.

        Raises:
            UsageError: the videos, flags or options are not valid; the message says why.
            ServerLost: the server does not start.
        """
        require_arguments(cls.local, options)
        resolved = StreamSpec.from_dict({"preset": options.get("preset"), "recipe": read_recipe(recipe)}).recipe
        server = LocalServer(videos, workers=workers, flags=server_flags(resolved, options, *flags)).__enter__()
        with undo_on_error(server.stop):
            # V2V_KEYS may name a key for other servers.
            dataset = cls(server.address, batch_size, arrays, resolved, seed=seed, labels=labels, keys="", **options)
        dataset._stop_server = weakref.finalize(dataset, server.stop)
        return dataset

    @staticmethod
    def mix(weights: Mapping[V2VStreamDataset, float | Sequence[float]], seed: int = 0) -> Mixture:
        """Return a dataset of the batches of several datasets, in a fixed order.

            natural = V2VStreamDataset("tcp://127.0.0.1:5555", preset="natural")
            worlds = V2VStreamDataset("tcp://127.0.0.1:5556")
            for batch in V2VStreamDataset.mix({natural: 0.7, worlds: 0.3}):
                batch.voxels

        Each batch is one of a member's own, with the same bytes. The mixture has all methods of a dataset, takes ranks
        and loader workers, and its ``resume_state`` holds for all members. In an epoch it delivers batches of that
        epoch of each member, until the weights would need more of a member than there are; the rest is dropped. The
        members need equal batch sizes, arrays and shapes. Their connections each have a credit of their own. With
        several loader workers, samples of one decode (``samples_per_decode``) are mostly decoded separately.

        Args:
            weights: share of each dataset in the batches of an epoch, 0 to 1, or a list of its shares in epochs 0, 1,
                2 ...; the last one stays. The shares of an epoch sum to 1.
            seed: of the order.

        Raises:
            UsageError: the weights are not shares, or the datasets do not fit together.
        """
        return Mixture(weights, seed)

    def close(self) -> None:
        """Stop the server that :meth:`local` started, and free unused memory. Repeated calls do nothing.

        A closed dataset delivers no more batches. :meth:`state_dict` and :meth:`describe` still work.
        """
        self._is_closed = True
        self._buffers = BatchBuffers()
        if self._stop_server is not None:
            self._stop_server()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._is_closed:
            raise UsageError("this dataset is closed: iterate inside its with block, or create another dataset")

    def __getstate__(self) -> dict[str, Any]:
        # A spawned loader worker has no process group. A shallow copy shares the record of the position, and iterates
        # on its own.
        own = {"_position": copy.copy(self._position), "_buffers": BatchBuffers(), "_stop_server": None}
        return self.__dict__ | {"_ambient": distributed_rank() or self._ambient} | own

    def __repr__(self) -> str:
        own = "seed {seed}, rank {rank} of {world_size}".format_map(ours := self._settings())
        return f"V2VStreamDataset({ours['address']!r}, batch_size {ours['batch_size']}, {own})"

    def _repr_html_(self) -> str:
        ours = self._settings()
        rows = ours | {
            "arrays": ", ".join(ours["arrays"]),
            "epoch": self.epoch,
            "rank": f"{self.rank} of {self.world_size}",
        }
        return html_table("V2VStreamDataset", rows)

    @property
    def rank(self) -> int:
        """Return this process's rank, 0 .. world_size - 1."""
        return (self._explicit or distributed_rank() or self._ambient)[0]

    @property
    def world_size(self) -> int:
        """Return the number of ranks that share an epoch."""
        return (self._explicit or distributed_rank() or self._ambient)[1]

    @property
    def seed(self) -> int:
        """Return the seed of the draws and of the order."""
        seed: int = self._settings()["seed"]
        return seed

    @property
    def epoch(self) -> int:
        """Return the epoch that the next iteration delivers."""
        return self._position.start(self._consumer).epoch

    @property
    def stream(self) -> StreamIdentity | None:
        """Return the stream's resolved spec, digests and sequences per epoch; None before the first connection."""
        return self._position.stream

    def describe(self) -> dict[str, Any]:
        """Return the stream's identity and this consumer's settings as plain values, for a log.

        Raises:
            UsageError: the stream is not known yet, because no connection was opened.
        """
        stream = self.stream
        if stream is None:
            raise UsageError(f"the stream of {self._settings()['address']} is not known yet: iterate first")
        return {
            field.name: getattr(stream, field.name) for field in dataclasses.fields(StreamIdentity)
        } | self._settings()

    def _samples(self) -> tuple[object, ...]:
        """Return what names its samples, before the server's answer."""
        return self._connector.brokers, self._connector.seed, self._connector.options.spec(None, "")

    def _settings(self) -> dict[str, Any]:
        return {
            "address": ",".join(self._connector.brokers),
            "arrays": list(self._connector.arrays),
            "batch_size": self._connector.batch_size,
            "seed": self._connector.seed,
            "rank": self.rank,
            "world_size": self.world_size,
        }

    def __len__(self) -> int:
        """Return the number of batches in a whole epoch.

        It is the same when the next iteration resumes in the middle of an epoch, because loops that resume count from
        the epoch's beginning. Before the first iteration this connects to the server.

        Raises:
            UsageError: the dataset is closed.
            V2VError: the server does not answer, or refuses: see the errors of iterating.
        """
        self._require_open()
        start = self._position.start(self._consumer)
        stream = start.stream or self._offered
        if stream is None:
            stream = self._offered = self._ask_stream(start)
        return self._consumer.plan(stream, start.at_epoch(start.epoch)).batches

    def _ask_stream(self, start: ResumeState) -> StreamIdentity:
        # Not pinned: the spacing of siblings depends on the number of loader workers that iterate.
        with self._connected(start) as connection:
            return connection.conversation.stream

    @property
    def _consumer(self) -> Consumer:
        return Consumer(self._connector.batch_size, self.rank, self.world_size)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next iteration. It starts at the beginning, unless a state of that epoch was loaded.

        With a larger batch size or more ranks, less than a global batch may be left of a loaded state's epoch. Then
        the next iteration delivers the epoch after it, or no batches if the state's own epoch is set here.

        Raises:
            UsageError: the epoch is out of range, or a state of a later epoch was loaded and no pass has begun since:
                its samples would be repeated.
        """
        self._require_open()
        self._position.set_epoch(require_whole("epoch", epoch, 0, LARGEST_EPOCH))

    def state_dict(self) -> dict[str, Any]:
        """Return the position after the last batch that this process took.

        In a loader worker, this is the worker's own state, as ``torchdata.stateful_dataloader`` requires.

        Raises:
            UsageError: loader workers took the batches, so this process does not know the position.
        """
        return self._position.state(self._consumer).to_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Start the next iteration where ``state`` was taken.

        Args:
            state: from :meth:`state_dict` or ``Batch.resume_state``, taken with any batch size, number of loader
                workers and (for a rank's state) world size.

        Raises:
            StateMismatch: the state belongs to another seed or spec, or is none of this release.
            UsageError: it is no mapping, or a loader worker's state that this process cannot use.
        """
        self._require_open()
        self._position.load(self._read_state(state), self._consumer)

    def _read_state(self, state: Mapping[str, Any]) -> ResumeState:
        loaded = ResumeState.from_dict(state)
        seed = self._settings()["seed"]
        if loaded.seed != seed:
            raise StateMismatch(f"seed: the state has {loaded.seed}, this dataset {seed}; give seed={loaded.seed}")
        return (
            loaded if loaded.stream is None else dataclasses.replace(loaded, stream=self._check(loaded, loaded.stream))
        )

    def _check(self, _state: ResumeState, stream: StreamIdentity) -> StreamIdentity:
        """Return the stream of a state, if it is that of this dataset."""
        if "mixture" in stream.spec:
            raise StateMismatch("the state is of mixed datasets, this is one: load it in V2VStreamDataset.mix")
        self._connector.options.spec(stream, "the state")
        return stream

    def __getitem__(self, index: Any) -> Never:
        """Refuse an index.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            f"dataset[{index!r}]: a stream has no index; iterate, or take a batch by next(iter(dataset)). A V2VDataset "
            "makes samples by index"
        )

    def __iter__(self) -> Iterator[Batch]:
        self._require_open()
        if get_worker_info() is None:
            return self._iterate()
        send_before_exit()
        end_with_parent()
        return self._iterate(self._begin())  # stateful loaders ask for the state before the first batch

    def _begin(self) -> Any:
        begun = self._position.begin(self._consumer)
        if begun.repeats:
            warnings.warn(begun.warning, RepeatedSamplesWarning, stacklevel=3)
        stream = begun.state.stream
        if begun.done and stream is not None and not begun.batches(self._consumer.plan(stream, begun.state)):
            # A stateful loader may drop this iterator unused, but the epoch is over.
            self._position.finish(begun)
        return begun

    @contextmanager
    def _connected(self, start: ResumeState, workers: int = 0) -> Iterator[Connection]:
        """Yield an open connection to iterate with as one of ``workers`` loader workers, or only to ask (0)."""
        consumer = self.rank, self.world_size, max(workers, 1)
        with closing(self._connector.connection(start, *consumer)) as connection:
            connection.open()
            if (loader := get_worker_info()) is None or loader.id == 0:  # other loader workers would repeat it
                connection.conversation.stream.resolved.recipe.warn()
            if workers and start.stream is None:
                self._connector.compare(connection, start, *consumer)
            yield connection

    @contextmanager
    def _opened(self, begun: Iteration) -> Iterator[tuple[Any, Iteration, EpochPlan]]:
        """Yield what :meth:`_take` needs: an open connection, the pass with its stream, and the plan of its epoch."""
        with self._connected(begun.state, begun.workers) as connection:
            stream = connection.conversation.stream
            if begun.state.stream is None:
                begun = self._position.pin(begun, stream, connection.address)
            plan = self._consumer.plan(stream, begun.state)
            spec = stream.resolved
            if spec.samples_per_decode > 1 and not plan.shares_decodes(spec.sibling_spacing, begun.workers):
                warnings.warn(_NOT_SHARED, stacklevel=4)
            yield connection, begun, plan

    def _take(self, connection: Any, begun: Iteration, plan: EpochPlan, batches: Sequence[int]) -> Iterator[Batch]:
        """Yield the batches of these numbers."""
        after = functools.partial(self._consumer.after, begun.state, plan)
        for batch in deliver(
            connection, plan, batches, begun.state.epoch, after, self._buffers, shared_memory=self._shared_memory
        ):
            if self._needs_labels:
                require_labels(batch.provenance)
            yield batch

    def _iterate(self, begun: Any = None) -> Iterator[Batch]:
        with self._opened(begun or self._begin()) as (connection, begun, plan):
            if begun.state.is_beginning:
                plan.require_batches()
            batches = begun.batches(plan)
            for batch, number in zip(self._take(connection, begun, plan, batches), batches, strict=True):
                state = self._consumer.after(begun.state, plan, number, batch.resume_state["quarantine"])
                self._position.reached(begun, self._consumer, state, last=number == batches[-1])
                yield batch
                self._require_open()
        self._position.finish(begun)


class Mixture(V2VStreamDataset):
    """Stream the batches of several datasets in the order of :mod:`v2v_client.mixture`; see
    :meth:`V2VStreamDataset.mix`.

    Attributes:
        members: the datasets; closing the mixture closes them. Iterate only the mixture.

    Raises:
        UsageError: the weights are not shares, or the datasets do not fit together.
    """

    def __init__(self, weights: Mapping[V2VStreamDataset, float | Sequence[float]], seed: int) -> None:
        if not isinstance(weights, Mapping):
            raise UsageError(
                f"mix: {format_value(weights)}: give a dict of datasets with their weights, "
                "V2VStreamDataset.mix({first: 0.7, second: 0.3})"
            )
        for each in weights:
            if not isinstance(each, V2VStreamDataset) or isinstance(each, Mixture):
                hint = (
                    f"V2VStreamDataset({each!r}, ...)"
                    if isinstance(each, str)
                    else "a V2VStreamDataset that is no mixture"
                )
                raise UsageError(f"mix: {format_value(each)} is no dataset to mix: give {hint}")
        self.members = members = tuple(weights)
        self._weights = read_weights(weights.values())
        for number, member in enumerate(members):
            if any(member._samples() == other._samples() for other in members[:number]):
                raise UsageError(
                    f"mix: {member!r} is a member twice, so its samples would come twice: give one weight, or "
                    "another seed, recipe or address"
                )
        for name in ("arrays", "batch_size", "rank", "world_size"):
            values = [member._settings()[name] for member in members]
            if any(value != values[0] for value in values):
                raise UsageError(f"mix: the datasets have {name} = {', '.join(map(str, values))}; give all the same")
        self._seed = require_whole("seed", seed, 0, LARGEST_SEED)
        self._explicit, self._ambient = members[0]._explicit, members[0]._ambient
        self._position = Position(seed, members[0].epoch)
        self._offered, self._is_closed = None, False
        self._stop_server = lambda: [member.close() for member in members]  # type: ignore[func-returns-value]  # self would stay

    def _settings(self) -> dict[str, Any]:
        settings = [member._settings() for member in self.members]
        address = " + ".join(each["address"] for each in settings)
        return settings[0] | {"address": address, "seed": self._seed, "weights": self._weights}

    @property
    def _consumer(self) -> MixtureConsumer:
        batch_size = self.members[0]._consumer.batch_size
        return MixtureConsumer(batch_size, self.rank, self.world_size, self._seed, self._weights)

    def _ask_stream(self, start: ResumeState) -> StreamIdentity:
        return self._consumer.identity([member._ask_stream(start) for member in self.members])

    def _check(self, state: ResumeState, stream: StreamIdentity) -> StreamIdentity:
        streams = self._consumer.members_of(state, stream, len(self.members))
        for member, each in zip(self.members, streams, strict=True):
            member._check(state, each)
        return self._consumer.identity(streams)

    @contextmanager
    def _opened(self, begun: Iteration) -> Iterator[tuple[Any, Iteration, EpochPlan]]:
        pinned = begun.state.stream
        streams = (
            [None] * len(self.members) if pinned is None else map(StreamIdentity.from_dict, pinned.spec["members"])
        )
        with ExitStack() as stack:
            connections = []
            for member, stream, snapshot in zip(self.members, streams, self._snapshots(begun.state), strict=True):
                start = dataclasses.replace(begun.state, stream=stream, quarantine=snapshot)
                connections.append(stack.enter_context(member._connected(start, begun.workers)))
            forms = {each.address: each.conversation.layout for each in connections}
            if any(each.conversation.layout != connections[0].conversation.layout for each in connections):
                raise UsageError(f"mix: samples differ in form, {forms}: give recipes of one size, and one voxel_dtype")
            stream = self._consumer.identity([each.conversation.stream for each in connections])
            begun = self._position.pin(begun, stream, "this mixture")
            consumer, needed = self._consumer, self.world_size * self.members[0]._consumer.batch_size
            for each, weight in zip(connections, consumer.shares(begun.state.epoch), strict=True):
                if weight and each.conversation.stream.sequences < needed:
                    raise UsageError(
                        f"mix: {each.address} gives {each.conversation.stream.sequences} sequences, and a batch of all "
                        f"ranks needs {needed}: use a smaller batch_size, fewer ranks or more videos"
                    )
            yield connections, begun, consumer.plan(stream, begun.state)

    def _snapshots(self, state: ResumeState) -> list[int | None]:
        return [*state.quarantine] if isinstance(state.quarantine, list | tuple) else [None] * len(self.members)

    def _take(self, connections: Any, begun: Iteration, plan: EpochPlan, batches: Sequence[int]) -> Iterator[Batch]:
        consumer, state, snapshots = self._consumer, begun.state, self._snapshots(begun.state)
        order = consumer.order(state.stream, state.epoch)  # type: ignore[arg-type]  # it was pinned
        places = plan.position // plan.batch_size + np.array(batches, np.int64)
        taken = [
            member._take(
                connection,
                begun,
                member._consumer.plan(connection.conversation.stream, state.at_epoch(state.epoch)),
                np.flatnonzero(np.isin(np.flatnonzero(order == number), places)).tolist(),
            )
            for number, (member, connection) in enumerate(zip(self.members, connections, strict=True))
        ]
        for batch_number, number in zip(batches, order[places].tolist(), strict=True):
            batch = next(taken[number])
            snapshots[number] = batch.resume_state["quarantine"]
            after = consumer.after(state, plan, batch_number, tuple(snapshots))
            yield dataclasses.replace(batch, resume_state=after.to_dict())
