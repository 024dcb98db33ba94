"""The process of a server worker, which carries out the steps of its conversation.

Sending happens in ZeroMQ's own thread while the next sample is made. The process may be killed at any moment; it leaves
nothing that would have to be undone.

Memory: besides the sample being made, the clips that its lease's siblings need, each cropped to its own view: at most
(samples_per_decode - 1) x frames x window bytes.

A sample is made in its consumer's slot, or in private memory if the slot is not accessible. The arena is opened and
mapped for each sample, which takes less than a millisecond. So no mapping keeps the memory of a consumer that is gone,
and a killed worker leaves nothing to clean up. A confined worker cannot open it, and receives its descriptor from the
server (:func:`v2v_server.worker.logbook.take_arena`). An arena with one slot, such as the server's
(:mod:`v2v_server.sharing`), is new memory as a rule. Writing a finished sample to it takes less than half the time
of mapping it, because its pages need no zeros and no faults.
"""

from __future__ import annotations

import gc
import math
import mmap
import os
import secrets
import signal
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.resources.abc import Traversable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import zstandard

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import (
    NO_SLOT,
    ArenaName,
    Slot,
    array_offsets,
    find_memory,
    open_memory,
)
from v2v_protocol.errors import ProtocolError, SidecarError, UsageError, VideoError
from v2v_protocol.keys import key_for, leaves_host
from v2v_protocol.link.dealer import Dealer, diagnose, wait_for_any
from v2v_protocol.messages import Buffer, Frames, Lease, Notes, Ping, Result, WorkerHello, encode, encode_sample
from v2v_protocol.sample import Form, Layout, new_arrays
from v2v_server.corpus.sources.sidecars import sidecar_id
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES
from v2v_server.simulation.precision import USUAL
from v2v_server.store.cache import Cache
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.log import Log
from v2v_server.system.process import (
    die_with_parent,
    give_way,
    keep_freed_memory,
    limit_memory,
    limit_processor_time,
    memory_limit,
    resident_bytes,
    take_long_turns,
)
from v2v_server.system.sandbox import confine
from v2v_server.worker.arrays.boxes import read_ahead
from v2v_server.worker.conversation import (
    CREDIT,
    Inspect,
    Leave,
    Listen,
    Load,
    Make,
    Readiness,
    Reconnect,
    Say,
    Send,
    WorkerAction,
    WorkerConversation,
)
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.logbook import IDLE, note, take_arena
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.plan import kernels_of
from v2v_server.worker.making.read import Clips, open_sidecars
from v2v_server.worker.warm_up import is_compiled, load_in_turn, warm_up_in_turn

Find: TypeAlias = Callable[[ArenaName, bool], int]
_Place: TypeAlias = tuple[str, np.dtype[Any], tuple[int, ...], int, int]
_SOON_FETCHED_BYTES = 32 << 20
"""The worker keeps its leases while it fetches a video up to this size; it returns them for a larger one."""
LONGEST_LEASE_SECONDS = 3600.0
"""Limit of processor time for one lease. The server gives up its own workers sooner, by wall-clock time; this limit
ends hung workers on other hosts."""
MOST_NAME_BYTES = 200
"""Longest name that an operator may give a worker. With the suffix that makes it unique it has at most 255 bytes."""
_LONGEST_ARENA_SECONDS = 1.0
"""Longest wait for a lease's arena, which is sent before the lease. Without it the sample goes into the message."""
_LINGER_MS = 5000
"""Time that leaving may spend on sending the last sample."""
_ASK_SECONDS = 3.0
"""A server that does not answer a new worker in this time is reported before the kernels are compiled."""


@dataclass(frozen=True, slots=True)
class OutputBuffer:
    """Memory for a sample.

    Attributes:
        arrays: C-contiguous, of the sample's layout, with unspecified content. Shared memory is unmapped when they are
            freed.
        in_slot: whether they are the slot that the lease names.
        find: how the lease's arena is found.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    in_slot: bool
    find: Find = find_memory


def open_output_buffer(lease: Lease, layout: Layout, find: Find = find_memory) -> OutputBuffer:
    """Return the lease's slot if it names an accessible one, otherwise new memory.

    Args:
        lease: the work.
        layout: layout of its sample.
        find: how its arena is found, see :func:`v2v_protocol.arena.open_memory`.
    """
    if lease.slot != NO_SLOT and not _has_one_slot(lease.arena):
        there = slot_arrays(Slot(lease.arena, lease.slot), layout, find)
        if there is not None:
            return OutputBuffer(there, in_slot=True)
    return OutputBuffer(new_arrays(layout), in_slot=False, find=find)


def sample_message(
    lease: Lease,
    buffer: OutputBuffer,
    *,
    provenance: Mapping[str, Any],
    worker: str,
    cpu_seconds: float,
    decoded: bool = True,
    cache: str = "",
    packed: bool = False,
) -> Frames:
    """Build the frames of a lease's sample. The buffer must not be changed afterwards.

    Args:
        lease: the work.
        buffer: where its sample was made.
        provenance, worker, cpu_seconds, decoded, cache: see :class:`v2v_protocol.messages.SampleHeader`.
        packed: compress arrays outside a slot even if the lease does not ask for it.
    """
    in_slot = buffer.in_slot or (_has_one_slot(lease.arena) and _write(lease, buffer))
    return encode_sample(
        epoch=lease.epoch,
        index=lease.indices[0],
        arrays=buffer.arrays,
        provenance=provenance,
        worker=worker,
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        cache=cache,
        slot=lease.slot,
        in_slot=in_slot,
        quarantine=lease.quarantine,
        pack=pack if packed or lease.packed else None,
    )


def pack(raw: Buffer) -> bytes:
    """Compress an array's bytes to one zstd frame that states their number."""
    # Level 1 leaves a twelfth of the bytes; higher levels take longer and save little more (v2v-tradeoff).
    return zstandard.ZstdCompressor(level=1, write_checksum=False).compress(raw)


def slot_arrays(slot: Slot, layout: Layout, find: Find = find_memory) -> dict[str, npt.NDArray[Any]] | None:
    """Map the arrays of a slot. ``find`` finds its arena.

    Returns:
        None if that is not possible: the arena is not on this host, belongs to another user, is gone, has another size,
        or could be truncated by its owner during a write.
    """
    try:
        name = ArenaName.parse(slot.arena)
        if not 0 < slot.number <= name.slots:
            return None
        places, total = _places(tuple(layout.items()), name.slots)
        descriptor = open_memory(name, total, writable=True, find=find)
        try:
            return {
                array: _map(descriptor, offset + (slot.number - 1) * size, size).view(dtype).reshape(shape)
                for array, dtype, shape, size, offset in places
            }
        finally:
            os.close(descriptor)
    except (OSError, ProtocolError):
        return None


def _has_one_slot(arena: str) -> bool:
    try:
        return bool(arena) and ArenaName.parse(arena).slots == 1
    except ProtocolError:
        return False


def _write(lease: Lease, buffer: OutputBuffer) -> bool:
    """Write a sample to the lease's arena of one slot; return False if it is not accessible or memory is full."""
    raw = [array.reshape(-1).view(np.uint8).data for array in buffer.arrays.values()]
    *offsets, total = array_offsets([len(each) for each in raw], 1)
    try:
        descriptor = open_memory(ArenaName.parse(lease.arena), total, writable=True, find=buffer.find)
        try:
            for offset, rest in zip(offsets, raw, strict=True):
                while rest:
                    written = os.pwrite(descriptor, rest, offset)
                    offset, rest = offset + written, rest[written:]
        finally:
            os.close(descriptor)
    except OSError:
        return False
    return True


@lru_cache(maxsize=16)  # the same for every sample of a stream
def _places(layout: tuple[tuple[str, tuple[str, tuple[int, ...]]], ...], slots: int) -> tuple[list[_Place], int]:
    """Return (name, dtype, shape, bytes of one sample, offset of the first) of each array in an arena, and the
    arena's bytes.
    """
    sizes = Form.of(dict(layout)).sizes
    *offsets, total = array_offsets(sizes, slots)
    places = [
        (array, np.dtype(dtype), shape, size, offset)
        for (array, (dtype, shape)), size, offset in zip(layout, sizes, offsets, strict=True)
    ]
    return places, total


def _map(descriptor: int, offset: int, size: int) -> npt.NDArray[np.uint8]:
    """Map bytes of an arena; they are unmapped when nothing refers to them any more."""
    begin = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
    # Map all pages at once: faulting them in one by one costs more than copying the sample.
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    mapping = mmap.mmap(descriptor, offset - begin + size, flags, offset=begin)
    return np.frombuffer(mapping, np.uint8, size, offset - begin)


class Worker:
    """One worker: sockets, kernels and clips, and the conversation that decides what to do with them.

    Only a VideoError is reported as a failure of the video. Any other exception ends the process with a traceback. Its
    sample is then given to another worker, and a broken installation exhausts the server's crash budget instead of
    producing a stream that silently lacks samples.

    Args:
        name: unique name, see :func:`unshared_name`.
        source: where the videos come from.
        brokers: where the brokers that it works for listen for workers.
        logbook: descriptor of the file for the lease in work, see :mod:`v2v_server.worker.logbook`.
        cache: cache of decoded clips for later epochs; None stores nothing.
        keys: file of its key; None reads the file that ``V2V_KEYS`` names, "" uses no key.
        log: log for people.
        arenas: receives the arenas of leases from a server on this host; None opens them by their names. Such a worker
            makes no other socket once it has heard its server, unless the videos come from a network.
        insecure: see :class:`v2v_protocol.link.dealer.Dealer`.

    Raises:
        UsageError: a socket cannot connect to its address.
        KeyRefused: the key file cannot be used.
    """

    def __init__(
        self,
        name: str,
        source: VideoSource,
        brokers: Sequence[str],
        logbook: int | None = None,
        cache: Cache | None = None,
        keys: str | None = None,
        log: Log | None = None,
        arenas: socket.socket | None = None,
        *,
        insecure: bool = False,
    ) -> None:
        self._links = [Dealer(address, keys, "worker", insecure=insecure) for address in brokers]
        self._name = name
        self._log = log or Log()
        self._logbook = logbook
        self._find = find_memory if arenas is None else partial(take_arena, arenas)
        self._is_confined = arenas is None
        self._clips = Clips(source, cache)
        self._at = IDLE  # the lease in work
        if cache is not None:
            cache.on_wait = self._note_wait
        self._source = source
        self._sidecars: tuple[ClipJob | None, dict[str, Traversable | None] | SidecarError] = None, {}  # the last ones
        self._unfetched: tuple[dict[str, str], VideoError] | None = None  # the last files that could not be fetched
        self._are_remote = [leaves_host(address) for address in brokers]
        self._kernels = set(USUAL)  # loaded kernels
        self._handover_seconds = 0.0  # not yet reported in a result
        self._memory_bytes, self._weigh_at = 0, -math.inf
        self._conversation = WorkerConversation(
            WorkerHello(
                name,
                NUMERICS_VERSION,
                CREDIT,
                socket.gethostname(),
                secrets.token_bytes(32),
                notes=Notes(memory_bytes=memory_limit()),
            ),
            brokers,
            is_watched=logbook is not None,
        )
        try:
            for link in self._links:
                link.connect()
        except UsageError as error:
            self.close()
            raise UsageError(f"--connect: {error}") from error

    def stop(self) -> None:
        """Finish the current sample, return the other leases, and leave. Safe to call from a signal handler."""
        self._conversation.stop()

    def run(self) -> None:
        """Work until told to stop.

        Raises:
            RemoteError: the only broker rejects this worker (another numerics version).
            ProtocolError: the only broker speaks another version of the protocol, a message cannot be read, or each of
                several brokers was left for such a reason.
            KeyRefused: the only broker rejects the key.
        """
        try:
            actions = self._conversation.start(time.monotonic())
            while actions:
                *said, step = actions
                for action in said:
                    self._do(action)
                actions = self._take(step)
        finally:
            for link, broker in zip(self._links, self._conversation.brokers, strict=True):
                # Without a server there is no message worth waiting for.
                link.disconnect(linger_ms=_LINGER_MS if broker.is_there else 0)
            self.close()

    def close(self) -> None:
        """Close all connections."""
        for link in self._links:
            link.close()

    def _do(self, action: WorkerAction) -> None:
        if isinstance(action, Send):
            began = time.monotonic()
            self._links[action.broker].send(action.frames)
            self._handover_seconds += time.monotonic() - began
        elif isinstance(action, Reconnect) and self._find is find_memory:
            # Always with the same IP version: at most 320 s pass until the next connection, and "localhost" and most
            # names have two, of which the server listens on one.
            self._links[action.broker].connect()
        elif isinstance(action, Say):
            self._log.say(f"{self._name}: {action.text}", "warning", worker=self._name)

    def _take(self, step: WorkerAction) -> list[WorkerAction]:
        """Carry out a step and return the conversation's next actions."""
        conversation = self._conversation
        match step:
            case Listen(seconds):
                messages = self._messages(seconds)
                return conversation.on_messages(messages, time.monotonic())
            case Inspect(lease):
                return conversation.on_inspected(self._inspect(ClipJob.of(lease), lease.indices[0]), time.monotonic())
            case Load(lease):
                clip = ClipJob.of(lease)
                for variant in kernels_of(clip) - self._kernels:
                    load_in_turn(variant)
                    self._kernels.add(variant)
                self._fetch(clip, lease.indices[0])
                self._open_sidecars(clip)
                return conversation.on_kernels_loaded(time.monotonic())
            case Make(lease, broker):
                if not self._clips.has(ClipJob.of(lease), lease.indices[0]):
                    give_way()  # processor caches are cold before a new clip, but warm within one
                limit_processor_time(LONGEST_LEASE_SECONDS)
                self._at = lease.lease
                note(self._logbook, self._at, decodes=True)
                try:
                    made: tuple[Frames, Result] | VideoError | SidecarError = self._make_sample(lease, broker)
                except (VideoError, SidecarError) as error:
                    made = error
                note(self._logbook, IDLE)  # not after another exception: it ends the worker, and this lease is to blame
                now = time.monotonic()
                if isinstance(made, VideoError | SidecarError):
                    return conversation.on_failure(made, now)
                frames, work = made
                return conversation.on_sample(frames, now, work)
            case Leave(reason) if reason:
                raise ProtocolError(reason)
            case _:
                return []

    def _inspect(self, clip: ClipJob, index: int) -> Readiness:
        """Return what the work on a sample of a clip needs."""
        missing, has_video = kernels_of(clip) - self._kernels, self._has_video(clip, index)
        is_ready = not missing and has_video and (not clip.sidecars or self._sidecars[0] == clip)
        is_small = has_video or _size_bytes(clip) <= _SOON_FETCHED_BYTES
        return Readiness(is_ready, is_small and all(map(is_compiled, missing)), self._clips.has(clip, index))

    def _note_wait(self, waits: bool) -> None:
        """Exclude a wait for other processes from the decoding time."""
        note(self._logbook, self._at, decodes=not waits)

    def _has_video(self, clip: ClipJob, index: int) -> bool:
        """Return whether work on a sample can begin: its video is on this host, or fetching it has failed, which is
        reported.
        """
        if self._clips.has(clip, index):
            return True
        files = _files(clip)
        self._source.expected = clip.video, clip.state
        return (self._unfetched is not None and self._unfetched[0] == files) or self._source.has(files)

    def _fetch(self, clip: ClipJob, index: int) -> None:
        """Fetch a sample's files before its lease is begun, so that network time does not count against the sample."""
        if self._has_video(clip, index):
            return
        files = _files(clip)
        try:
            self._source.fetch(files)
        except VideoError as error:
            self._unfetched = files, error

    def _open_sidecars(self, clip: ClipJob) -> dict[str, Traversable | None] | SidecarError:
        """Read a clip's sidecars before its lease is begun, so that their time does not count against the sample.
        Siblings use them too; the next clip checks them again.
        """
        if self._sidecars[0] != clip:
            try:
                with open_sidecars(clip, self._source) as opened:
                    if clip.sidecars:
                        read_ahead(clip, opened)
                    self._sidecars = clip, opened
            except SidecarError as error:
                self._sidecars = clip, error
        return self._sidecars[1]

    def _messages(self, wait_seconds: float) -> list[tuple[int, bytes | UsageError]]:
        """Return all available messages: of each its broker's number, and its first frame or why that is refused."""
        messages: list[tuple[int, bytes | UsageError]] = []
        wait_for_any(self._links, wait_seconds)
        for broker, link in enumerate(self._links):
            while (frames := link.receive(0)) is not None:
                messages.append((broker, bytes(frames[0])))
            try:
                link.has_reconnected()  # raises if the server refuses the key; the conversation notices interruptions
            except UsageError as error:
                messages.append((broker, error))
        if messages and not self._is_confined:
            # Only now, because ZeroMQ connects in a thread of its own. No lease came before, so no video was opened.
            # A worker that loses this connection falls silent, and is ended and replaced by its server.
            confine(None, network=not self._source.is_local)
            self._is_confined = True
        return messages

    def _make_sample(self, lease: Lease, broker: int) -> tuple[Frames, Result]:
        """Make the sample of a broker's lease; return its message and what it took.

        Raises:
            VideoError, SidecarError: its video, or a file beside it, cannot be used.
        """
        job = SampleJob.of(lease)
        if self._unfetched is not None and self._unfetched[0] == _files(job.clip):
            error, self._unfetched = self._unfetched[1], None
            if error.video == lease.video:
                raise error  # otherwise opening the sidecar reports it
        began = time.monotonic()
        buffer = open_output_buffer(lease, job.clip.layout, self._find)
        has_room = time.monotonic()
        started = time.process_time()
        decoded, is_new = self._clips.take(job.clip, lease.indices)
        note(self._logbook, lease.lease)
        if is_new and not decoded.clip.origin:
            # PyAV creates a reference cycle for a frame whose side data (its orientation) was read. Python's collector
            # counts few objects and waits, but each of them holds pictures.
            gc.collect()
        has_clip = time.monotonic()
        sidecars = self._open_sidecars(job.clip)
        if isinstance(sidecars, SidecarError):
            self._sidecars = None, {}  # the next lease tries again
            raise sidecars
        sample = make_sample(job, decoded, buffer.arrays, sidecars)
        has_sample = time.monotonic()
        frames = sample_message(
            lease,
            buffer,
            provenance=sample.provenance.to_dict(),
            worker=self._name,
            cpu_seconds=time.process_time() - started,
            decoded=is_new,
            cache=self._clips.said_of_cache(decoded) if is_new else "",
            packed=self._are_remote[broker],
        )
        work = Result(
            lease.lease,
            decode_seconds=has_clip - has_room,
            simulate_seconds=has_sample - has_clip,
            handover_seconds=self._handover_seconds + has_room - began,
            memory_bytes=self._memory(has_sample),
        )
        self._handover_seconds = time.monotonic() - has_sample
        return frames, work

    def _memory(self, now: float) -> int:
        """Return the resident memory of this process, bytes, measured at most once a second."""
        if now >= self._weigh_at:
            self._weigh_at, self._memory_bytes = now + 1.0, resident_bytes()
        return self._memory_bytes


def unshared_name(beginning: str | None) -> str:
    """Return a name that no other worker has: the server refuses the second worker of a name.

    Args:
        beginning: the operator's name for the worker, which may be shared; None: host and process id, which may be
            equal in containers.

    Raises:
        UsageError: it is too long with what is added to it.
    """
    if beginning is not None and len(beginning.encode()) > MOST_NAME_BYTES:
        raise UsageError(f"--name has {len(beginning.encode())} bytes: give at most {MOST_NAME_BYTES}")
    return f"{beginning or f'{socket.gethostname()}-{os.getpid()}'}-{secrets.token_hex(4)}"


def _size_bytes(clip: ClipJob) -> int:
    """Return the size of a clip's video, which starts the fingerprint."""
    size = clip.fingerprint.partition("-")[0]
    return int(size) if size.isdecimal() else 0


def _files(clip: ClipJob) -> dict[str, str]:
    """Return the fingerprints of the files that a clip's samples are made from, by id."""
    beside = {sidecar_id(clip.video, ending): sidecar.fingerprint for ending, sidecar in clip.sidecars.items()}
    return {clip.video: clip.fingerprint, **beside}


def _ask(address: str, keys: str | None, log: Log, *, insecure: bool) -> None:
    """Ask whether the server answers, and say if it does not: the worker then waits, and compiles its kernels before.

    Raises:
        UsageError: see :func:`run_worker`.
    """
    with closing(Dealer(address, keys, "worker", insecure=insecure)) as link:
        link.connect()
        link.send(encode(Ping()))
        deadline = time.monotonic() + _ASK_SECONDS
        while time.monotonic() < deadline:
            if link.receive(_ASK_SECONDS / 10) is not None:
                return
            link.has_reconnected()
    log.say(f"{address}: {diagnose(address)}; waiting for it", "warning")


def run_worker(
    brokers: Sequence[str],
    source: VideoSource,
    name: str | None,
    parent_pid: int | None,
    logbook: int | None = None,
    cache: Cache | None = None,
    keys: str | None = None,
    log: Log | None = None,
    arenas: int | None = None,
    *,
    insecure: bool = False,
) -> None:
    """Run one worker in this process until its brokers stop it.

    Args:
        brokers: where each of them listens for workers.
        source: where the videos come from.
        name: unique name; by default host, process id and a random suffix.
        parent_pid: process id of the server if it started this worker, which then ends with it.
        logbook: descriptor of the file for the lease in work, see :mod:`v2v_server.worker.logbook`.
        cache: cache of decoded clips for later epochs; None stores nothing.
        keys: file of its key; None reads the file that ``V2V_KEYS`` names, "" uses no key.
        log: log for people.
        arenas: descriptor of its end of the socket pair for arenas if a server started it, see
            :mod:`v2v_server.worker.logbook`; not used for a server on another host.
        insecure: without a key, also work for a server on loopback that belongs to another user.

    Raises:
        UsageError: a socket cannot connect to its address, or the only broker rejects the key or belongs to another
            user.
        RemoteError, ProtocolError: see :meth:`Worker.run`.
    """
    if parent_pid is not None:
        die_with_parent(parent_pid)
    for address in brokers:
        key_for(address, "worker", keys)  # reports a wrong key at once
        if logbook is None:
            try:
                _ask(address, keys, log or Log(), insecure=insecure)
            except UsageError:
                if len(brokers) == 1:  # one of several must not keep the worker from the others; it is asked again
                    raise
    keep_freed_memory()
    limit_memory(LARGEST_MEMORY_BYTES)
    # A worker uses one core. OpenCV reads this when it is loaded, which some recipes never do.
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    # Compile or load the kernels first, so that a worker that says hello works at full speed.
    warm_up_in_turn()
    # Exclude objects that exist by now from collections, which then take a fraction of a millisecond.
    gc.collect()
    gc.freeze()
    # Before ZeroMQ starts its threads, so that these are confined to the same files.
    pool = socket.socket(fileno=arenas) if arenas is not None and brokers[0].startswith("ipc:") else None
    if pool is not None:
        pool.settimeout(_LONGEST_ARENA_SECONDS)
    written = [*compile_cache(), *([] if cache is None else [cache.folder])]
    # The tools for object storage write elsewhere, and a worker of this host without a pool opens arenas itself.
    confines_files = source.is_local and (pool is not None or all(map(leaves_host, brokers)))
    confine(written if confines_files else None, network=True)
    worker = Worker(name or unshared_name(None), source, brokers, logbook, cache, keys, log, pool, insecure=insecure)
    signal.signal(signal.SIGTERM, lambda number, frame: worker.stop())
    # After ZeroMQ's threads have started, which should run without delay.
    take_long_turns()
    worker.run()
