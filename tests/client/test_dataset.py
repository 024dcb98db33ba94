import copy
import dataclasses
import gc
import itertools
import os
import pickle
import resource
import threading
from types import MappingProxyType

import numpy as np
import psutil
import pytest
import torch
from torch._utils import ExceptionWrapper
from torch.utils.data import DataLoader

from tests.client.fake_server import SPEC, FakeServer, expected
from v2v_client import (
    ProtocolError,
    RemoteError,
    RepeatedSamplesWarning,
    SampleUnavailable,
    ServerLost,
    StateMismatch,
    UsageError,
    V2VStreamDataset,
)
from v2v_client.options import Patience
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import Denied, decode, decode_map, encode, encode_map
from v2v_protocol.sample import array_layout
from v2v_server.worker.process import slot_arrays

SEED = 5
QUICK = Patience(ping_seconds=0.05, rewant_seconds=0.2)


@pytest.fixture
def server():
    with FakeServer(sequences=23, credit=8) as running:
        yield running


@pytest.fixture(scope="module", autouse=True)
def old_objects():
    """Freeze existing objects, so that garbage collection skips them: with torch it takes a third of a second."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.fixture(autouse=True)
def nothing_leaks(old_objects):
    gc.collect()
    process = psutil.Process()
    threads, files, children = process.num_threads(), process.num_fds(), len(process.children())
    before = set(threading.enumerate())
    yield
    gc.collect()
    others = [thread for thread in threading.enumerate() if thread not in before]
    for thread in others:
        thread.join(60.0)  # PyTorch closes the queues of its workers without waiting for the threads that feed them
    assert [thread.name for thread in others if thread.is_alive()] == []
    # Pools of OpenMP and of multiprocessing's helpers may begin in a test; a leak in each of them would add up.
    assert process.num_fds() - files <= 4
    assert process.num_threads() - threads <= 4
    assert len(process.children()) - children <= 2  # multiprocessing's resource tracker and fork server


def dataset(server, **options):
    options = {"batch_size": 4, "seed": SEED, "timeout_seconds": 60.0, "patience": QUICK} | options
    return V2VStreamDataset(server.address, **options)


def places(batches):
    return [(batch.epoch, index) for batch in batches for index in batch.indices]


def epoch_places(epoch, start=0, stop=20):
    return [(epoch, index) for index in range(start, stop)]


def assert_true_bytes(batch, spec=SPEC):
    for name, tensor in batch.arrays.items():
        for row, index in enumerate(batch.indices):
            np.testing.assert_array_equal(tensor[row].numpy(), expected(name, SEED, batch.epoch, index, spec))


# --- what comes -------------------------------------------------------------------------------------------------------


def test_one_iteration_is_one_epoch_in_order_with_the_bytes_of_each_sample(server):
    stream = dataset(server)
    for epoch in (0, 1):
        batches = list(stream)
        assert places(batches) == epoch_places(epoch)
        for batch in batches:
            assert_true_bytes(batch)
            assert batch.cpu_seconds == 1.0
            assert batch.wait_seconds >= 0
            assert [item.id.index for item in batch.provenance] == list(batch.indices)
    assert server.most_unanswered <= server.credit
    assert server.refused_for_credit == 0


def test_the_batch_has_the_promised_form(server):
    batch = next(iter(dataset(server)))
    assert batch.voxels.shape == (4, 2, 2, 4, 6)
    assert batch.voxels.dtype is torch.int8
    assert batch.frames.shape == (4, 2, 1, 4, 6)
    assert batch.frames.dtype is torch.uint8
    assert len(batch) == 4
    assert repr(batch) == (
        "Batch(voxels: int8[4, 2, 2, 4, 6] on cpu, frames: uint8[4, 2, 1, 4, 6] on cpu, epoch 0, indices 0, 1, 2, ...)"
    )
    moved = batch.to("cpu", non_blocking=True)
    assert torch.equal(moved.voxels, batch.voxels)
    assert moved.indices == batch.indices


def test_only_the_requested_arrays_arrive(server):
    batch = next(iter(dataset(server, arrays=("voxels",))))
    assert "voxels" in batch
    assert "frames" not in batch
    with pytest.raises(UsageError, match=r"batch\.frames: .* only voxels; .* arrays=\('voxels', 'frames'\)"):
        _ = batch.frames
    assert_true_bytes(batch)
    assert server.hellos[-1].arrays == ("voxels",)


def test_arrival_order_and_duplicates_do_not_change_batches(server):
    server.shuffled = True
    server.twice = {(0, index) for index in range(0, 23, 3)}
    batches = list(dataset(server))
    assert places(batches) == epoch_places(0)
    for batch in batches:
        assert_true_bytes(batch)
    assert server.most_unanswered == server.credit
    assert server.refused_for_credit == 0


def test_ranks_are_those_of_torch_distributed(server, tmp_path):
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        stream = dataset(server)
        assert (stream.rank, stream.world_size) == (0, 1)
    finally:
        torch.distributed.destroy_process_group()


def test_options_reach_the_server(server):
    recipe = {"voxels_per_clip": 3, "threshold": [0.2, 0.5]}
    stream = dataset(server, recipe=MappingProxyType(recipe), voxel_dtype="int16", shuffle=False)
    asked = {"recipe": copy.deepcopy(recipe), "voxel_dtype": "int16", "shuffle": False}
    recipe["gamma"], recipe["threshold"][0] = 1.5, 0.3  # the dataset has a copy
    batch = next(iter(stream))
    assert batch.voxels.shape == (4, 3, 2, 4, 6)
    assert batch.voxels.dtype is torch.int16
    assert server.hellos[0].spec == asked
    described = stream.describe()
    assert described["spec"]["recipe"]["voxels_per_clip"] == 3
    assert described["sequences"] == 23


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"batch_size": 0}, "batch_size"),
        ({"seed": -1}, "seed"),
        ({"epoch": -1}, "epoch"),
        ({"arrays": ("voxel",)}, "voxel"),
        ({"recipe": "papier"}, "papier"),
        ({"recipe": {"gama": 2}}, "gama"),
        ({"rank": 1}, "give both"),
        ({"rank": 2, "world_size": 2}, "rank 2"),
        ({"timeout_seconds": 0.0}, "timeout_seconds"),
        ({"flow_from": -1}, "flow_from"),
        ({"flow_from": 41, "recipe": "paper"}, "flow_from"),
        ({"flow_from": 4, "recipe": {"voxels_per_clip": 3}}, "flow_from"),
        ({"sibling_spacing": 8, "samples_per_decode": 1}, "sibling_spacing"),
        ({"sibling_spacing": 8, "preset": "exact"}, "sibling_spacing"),
    ],
)
def test_wrong_options_are_refused_at_once(options, word):
    with pytest.raises(UsageError, match=word):
        V2VStreamDataset("tcp://127.0.0.1:1", **options)


def test_options_that_depend_on_the_servers_spec_are_checked_by_the_server():
    """The server's own spec may have clips of 80 voxels, and four samples per decode."""
    for recipe in (None, {"bins": 3}):
        V2VStreamDataset("tcp://127.0.0.1:1", recipe=recipe, flow_from=60, sibling_spacing=48)
    V2VStreamDataset("tcp://127.0.0.1:1", moving_share=0.5, quiet_share=0.5)  # with scene auto
    with pytest.raises(UsageError, match="moving_share"):
        V2VStreamDataset("tcp://127.0.0.1:1", moving_share=0.5, scene="off")


def test_a_malformed_address_says_what_to_give():
    with pytest.raises(UsageError, match="tcp://host:port"):
        next(iter(V2VStreamDataset("localhost")))


# --- length and epochs ------------------------------------------------------------------------------------------------


def test_length_is_that_of_an_epoch_and_known_before_the_first_iteration(server):
    stream = dataset(server)
    assert len(stream) == len(loader(stream, 2)) == 5
    assert len(server.hellos) == 2  # one to learn the layout; later calls use the first answer
    assert stream.stream is None  # how siblings are spaced depends on how many loader workers iterate
    first = next(iter(stream))
    assert len(stream) == 5
    stream.load_state_dict(first.resume_state)
    assert len(list(stream)) == 4
    assert len(stream) == 5


def test_leaving_early_and_iterating_again_repeats_the_epoch(server):
    stream = dataset(server)
    for _ in stream:
        break
    assert stream.epoch == 0
    assert places(stream) == epoch_places(0)
    assert stream.epoch == 1
    stream.set_epoch(7)
    assert places(stream) == epoch_places(7)
    gc.collect()
    server.until_all_left()


@pytest.mark.parametrize("loaded", [False, True])
def test_an_epoch_set_while_another_is_finished_is_the_next_one(server, loaded):
    """A trainer may set the next epoch at the last batch, or while a thread reads ahead."""
    stream = dataset(server)
    batches = iter(stream)
    state = next(batches).resume_state
    if loaded:
        stream.load_state_dict({**state, "epoch": 5})
    else:
        stream.set_epoch(5)
    list(batches)
    assert stream.epoch == 5
    assert stream.state_dict()["epoch"] == 5
    assert places(stream) == epoch_places(5, 4 if loaded else 0)
    assert stream.epoch == 6


def test_an_epoch_without_a_whole_global_batch_is_refused(server):
    with pytest.raises(UsageError, match="23 sequences"):
        list(dataset(server, batch_size=12, rank=0, world_size=2))


# --- position ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("taken", [1, 3])
@pytest.mark.parametrize("other_batch", [4, 5, 1])
def test_resume_in_mid_epoch(server, taken, other_batch):
    stream = dataset(server)
    batches = iter(stream)
    states = [next(batches).resume_state for _ in range(taken)]
    assert stream.state_dict() == states[-1]
    state = pickle.loads(pickle.dumps(states[-1]))
    again = dataset(server, batch_size=other_batch)
    again.load_state_dict(state)
    assert again.state_dict() == state
    iter(again)  # a stateful loader may make an iterator that it does not use
    stop = 23 - (23 - 4 * taken) % other_batch
    assert places(again) == epoch_places(0, 4 * taken, stop)
    assert places(again)[0] == (1, 0)


def test_the_state_at_the_end_of_an_epoch_begins_the_next(server):
    stream = dataset(server)
    *_, last = stream
    assert stream.state_dict() == last.resume_state
    again = dataset(server)
    again.load_state_dict(last.resume_state)
    iter(again)
    assert places(again) == epoch_places(1)


@pytest.mark.parametrize("workers", [0, 1])
def test_set_epoch_to_a_loaded_epoch_with_no_batch_left_repeats_no_samples(server, workers):
    """Training loops over epochs call load_state_dict(state), then set_epoch(state["epoch"])."""
    batches = iter(dataset(server))
    state = [next(batches).resume_state for _ in range(4)][-1]
    again = dataset(server, batch_size=8)
    again.load_state_dict(state)
    loader = DataLoader(again, batch_size=None, num_workers=workers)
    again.set_epoch(0)
    again.set_epoch(0)
    assert len(again) == 2  # of a whole epoch
    assert places(loader) == []
    for epoch in (1, 0):
        again.set_epoch(epoch)
        assert places(loader) == epoch_places(epoch, 0, 16)


def test_resume_with_another_world_size(server):
    states = []
    before = []
    for rank in (0, 1):
        batches = iter(dataset(server, batch_size=2, rank=rank, world_size=2))
        taken = [next(batches) for _ in range(2)]
        before += places(taken)
        states.append(taken[-1].resume_state)
    assert states[0] == states[1]
    after = []
    for rank in (0, 1, 2):
        again = dataset(server, batch_size=2, rank=rank, world_size=3)
        again.load_state_dict(states[0])
        after += places(again)
    assert sorted(before + after) == epoch_places(0, 0, 20)


def test_a_state_restores_the_spec_when_none_is_given(server):
    state = next(iter(dataset(server, recipe={"voxels_per_clip": 3}))).resume_state
    again = dataset(server)
    again.load_state_dict(state)
    assert next(iter(again)).voxels.shape[1] == 3


def test_a_state_of_another_spec_seed_or_nothing_is_refused(server):
    state = next(iter(dataset(server))).resume_state
    with pytest.raises(StateMismatch, match=r"gamma 1.5 / 2.2"):
        dataset(server, recipe={"gamma": 1.5}).load_state_dict(state)
    with pytest.raises(StateMismatch, match="seed: the state has 5, this dataset 6"):
        dataset(server, seed=6).load_state_dict(state)
    for broken in ({}, {**state, "position": -1}, {**state, "extra": 1}, {**state, "version": 99}):
        with pytest.raises(StateMismatch, match="not a state of V2VStreamDataset"):
            dataset(server).load_state_dict(broken)


def test_a_state_of_a_value_that_is_gone_is_refused_with_the_remedy(server):
    state = next(iter(dataset(server))).resume_state
    state["spec"] = {**state["spec"], "tolerance": 0.1}
    said = (
        r"the stream of the state cannot be made: spec tolerance = 0.1: .* begin a new stream, or resume with the rel"
    )
    with pytest.raises(StateMismatch, match=said):
        dataset(server).load_state_dict(state)
    state["spec"]["tolerance"] = 0.0
    dataset(server).load_state_dict(state)


@pytest.mark.parametrize("change", [{"catalogue": "catalogue-2"}, {"sequences": 24}])
def test_another_catalogue_is_refused_naming_both_sides(server, change):
    state = next(iter(dataset(server))).resume_state
    (name, value), *_ = change.items()
    setattr(server, name, value)
    again = dataset(server)
    again.load_state_dict(state)
    with pytest.raises(StateMismatch, match=rf"the saved state has .* tcp://.* has {value}"):
        next(iter(again))


@pytest.mark.parametrize("taken", [2, 5])
def test_a_server_restarted_over_other_videos_is_refused_naming_both(server, taken):
    stream = dataset(server)
    for _ in itertools.islice(batches := iter(stream), taken):
        pass
    server.restart(catalogue="catalogue-2")
    said = rf"catalogue_digest: this dataset has catalogue-1, {server.address} has catalogue-2; serve the same folder"
    with pytest.raises(StateMismatch, match=said):
        list(itertools.chain(batches, stream))


# --- faults -----------------------------------------------------------------------------------------------------------


def test_after_a_server_restart_no_sample_is_lost_or_repeated(server):
    server.shuffled = True
    stream = dataset(server)
    batches = iter(stream)
    taken = [next(batches)]
    server.call(lambda: setattr(server, "held", True))
    server.restart(held=False)
    taken += batches
    assert places(taken) == epoch_places(0)
    for batch in taken:
        assert_true_bytes(batch)
    assert server.hellos[-1].spec == SPEC.to_dict()


def test_any_other_denial_for_credit_is_an_error(server):
    server.overstated = 3
    server.held = True
    with pytest.raises(RemoteError, match=r"\[credit\]"):
        next(iter(dataset(server)))


def test_a_dead_server_raises_with_address_and_last_sample(server):
    stream = dataset(server, timeout_seconds=2.0)
    batches = iter(stream)
    next(batches)
    server.call(lambda: setattr(server, "mute", True))
    with pytest.raises(ServerLost, match=rf"{server.address}: nothing received for .* last sample: epoch 0, index \d+"):
        list(batches)


def test_a_refusal_quotes_the_server(server):
    server.refusal = Denied("spec", "no video gives 5 frames")
    with pytest.raises(RemoteError, match="no video gives 5 frames") as caught:
        next(iter(dataset(server)))
    assert caught.value.code == "spec"


def test_a_sample_that_cannot_be_made_is_named(server):
    server.unavailable = {6}
    batches = iter(dataset(server, on_bad_video="raise"))
    with pytest.raises(SampleUnavailable, match=r"sample 6 of epoch 0: a.mp4 at frame 3: truncated"):
        list(batches)


def with_provenance(frames, change):
    header = decode(frames[0])
    changed = encode_map(change(decode_map(header.provenance)))
    return [*encode(dataclasses.replace(header, provenance=changed)), *frames[1:]]


GARBAGE = {
    "no message": lambda frames: [b"\xc1garbage", *frames[1:]],
    "an array too short": lambda frames: [frames[0], bytes(frames[1])[:-1], frames[2]],
    "an array less": lambda frames: frames[:2],
    "an array more": lambda frames: [*frames, b"x"],
    "another sample's provenance": lambda frames: with_provenance(
        frames, lambda was: was | {"id": was["id"] | {"catalogue_digest": "catalogue-9"}}
    ),
    "a provenance that is no map": lambda frames: with_provenance(frames, list),
    "a provenance of something else": lambda frames: with_provenance(frames, lambda was: {"id": was["id"]}),
    "another snapshot in the provenance": lambda frames: with_provenance(frames, lambda was: was | {"quarantine": 1}),
    "no snapshot in the provenance": lambda frames: with_provenance(frames, lambda was: was | {"quarantine": False}),
    "a provenance that cannot be read": lambda frames: [
        *encode(dataclasses.replace(decode(frames[0]), provenance=b"\xc1")),
        *frames[1:],
    ],
}


@pytest.mark.parametrize("damage", GARBAGE.values(), ids=GARBAGE.keys())
def test_malformed_server_messages_are_refused(server, damage):
    server.alter, server.workers = damage, "elsewhere"
    with pytest.raises(ProtocolError):
        next(iter(dataset(server)))


def test_a_frame_larger_than_the_layout_allows_never_reaches_memory(server):
    server.alter, server.workers = lambda frames: [frames[0], bytes(2 << 20), frames[2]], "elsewhere"
    with pytest.raises(ServerLost):
        next(iter(dataset(server, timeout_seconds=1.0)))


# --- loader workers ---------------------------------------------------------------------------------------------------


def loader(stream, workers, method="fork", **options):
    context = method if workers else None
    return DataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=context, **options)


@pytest.mark.parametrize(
    ("workers", "method"),
    [(0, None), (1, "fork"), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)],
)
def test_loader_workers_give_the_same_batches_and_the_epoch_advances(server, workers, method):
    stream = dataset(server)
    loaded = loader(stream, workers, method)
    for epoch in (0, 1):
        batches = list(loaded)
        assert places(batches) == epoch_places(epoch)
        for batch in batches:
            assert_true_bytes(batch)
        direct = dataset(server, epoch=epoch)
        assert [batch.resume_state for batch in batches] == [batch.resume_state for batch in direct]
    assert len(stream) == len(loaded) == 5


def test_more_loader_workers_than_batches(server):
    assert places(loader(dataset(server, batch_size=12), 2)) == epoch_places(0, 0, 12)


def test_persistent_workers_advance_and_obey_set_epoch(server):
    stream = dataset(server)
    loaded = loader(stream, 2, persistent_workers=True)
    assert places(loaded) == epoch_places(0)
    assert places(loaded) == epoch_places(1)
    for _ in loaded:
        break
    stream.set_epoch(9)
    assert places(loaded) == epoch_places(9)
    del loaded


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_the_state_of_a_batch_is_valid_for_any_number_of_loader_workers(server, workers):
    state = [batch.resume_state for batch in loader(dataset(server), 2)][1]
    again = dataset(server)
    again.load_state_dict(state)
    loaded = loader(again, workers)
    assert places(loaded) == epoch_places(0, 8)
    assert places(loaded) == epoch_places(1)


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_the_parents_state_is_refused_after_loader_workers_and_names_the_remedy(server, method):
    stream = dataset(server)
    assert stream.state_dict()["position"] == 0
    for batch in loader(stream, 1, method):
        kept = batch.resume_state
        break
    with pytest.raises(UsageError, match=r"Batch\.resume_state"):
        stream.state_dict()
    stream.load_state_dict(kept)
    assert stream.state_dict() == kept


@pytest.mark.parametrize("kind", [RemoteError, SampleUnavailable])
def test_a_refusal_in_a_loader_worker_keeps_its_code(kind):
    """PyTorch passes on its type, and its traceback as text."""
    try:
        raise kind("unknown-session", "the server refused [twice]: say Hello again")
    except kind:
        carried = ExceptionWrapper(where="in DataLoader worker process 0")
    with pytest.raises(kind, match=r"(?s)worker process 0.*say Hello again \[unknown-session\]$") as caught:
        carried.reraise()
    assert caught.value.code == "unknown-session"
    assert caught.value.text.endswith("the server refused [twice]: say Hello again")


def test_a_copy_is_a_dataset_of_its_own(server):
    stream = dataset(server)
    list(stream)
    other = copy.deepcopy(stream)
    assert other.epoch == 1
    other.set_epoch(4)
    assert stream.epoch == 1
    del stream
    assert places(other) == epoch_places(4)


# --- buffers ----------------------------------------------------------------------------------------------------------


def test_buffers_are_reused_in_the_next_epoch(server):
    stream = dataset(server, shared_memory=False)
    used = {batch.voxels.data_ptr() for _ in range(4) for batch in stream}
    assert len(used) <= 8 // 4 + 3
    assert copy.copy(stream)._buffers is not stream._buffers
    pickle.dumps(stream)


def test_arenas_are_reused_in_the_next_epoch(server):
    stream = dataset(server)
    for _ in range(4):
        assert sum(1 for _ in stream) == 5
    assert NO_SLOT not in server.slots
    assert len(set(server.arenas)) <= 8 // 4 + 3


@pytest.mark.parametrize("workers", ["here", "elsewhere", "many"])
@pytest.mark.parametrize("shared_memory", [True, False])
def test_local_and_remote_workers_give_the_same_bytes(server, workers, shared_memory):
    server.workers, server.shuffled = workers, True
    stream = dataset(server, shared_memory=shared_memory)
    kept = [batch for _ in range(3) for batch in stream]
    assert places(kept) == [place for epoch in range(3) for place in epoch_places(epoch)]
    for batch in kept:
        assert_true_bytes(batch)
    assert (set(server.slots) == {NO_SLOT}) is not shared_memory


def test_slots_stop_once_a_whole_batch_came_in_messages(server):
    server.workers = "elsewhere"
    list(dataset(server, batch_size=2))
    lent = [slot != NO_SLOT for slot in server.slots]
    assert lent == sorted(lent, reverse=True)
    assert 0 < sum(lent) <= 8 + 2 * 2


def test_many_small_batches_do_not_exhaust_open_files(monkeypatch):
    """Samples without an arena come in messages; arenas are reused as they come back."""
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, 64))
    with FakeServer(sequences=160, credit=40) as server:
        before, most = len(os.listdir("/proc/self/fd")), 0
        for batch in dataset(server, batch_size=1):
            assert_true_bytes(batch)
            most = max(most, len(os.listdir("/proc/self/fd")))
        assert most - before <= 64 // 4 + 20  # and those of the connection, and of the server's side in this process
        assert set(server.slots[:40]) == {NO_SLOT, 1}
        assert 1 in server.slots[-80:]


def test_a_late_write_of_an_abandoned_worker_does_not_change_a_batch(server):
    """Index 1 is lost with its worker, is requested again, and comes from another worker; then the first one wakes."""
    server.drop = {(0, 1)}
    stream = iter(dataset(server))
    batch = next(stream)
    assert_true_bytes(batch)
    layout = array_layout(SPEC.recipe, SPEC.voxel_dtype, ("voxels", "frames"))
    (slot,) = server.lost
    there = slot_arrays(slot, layout)
    if there is not None:
        for array in there.values():
            array[...] = 101
    assert_true_bytes(batch)
    for later in stream:
        assert_true_bytes(later)
    assert slot.arena not in server.arenas[server.arenas.index(slot.arena) + 1 :]


def steps(stream, count):
    return [index for batch in itertools.islice(stream, count) for index in batch.indices]


def test_repeating_an_iteration_that_was_left_early_warns_once(server):
    stream = dataset(server)
    next(iter(stream))  # a first look
    first = steps(stream, 2)
    with pytest.warns(RepeatedSamplesWarning, match=r"load_state_dict\(batch.resume_state\).*set_epoch"):
        assert steps(stream, 2) == first
    assert steps(stream, 2) == first


def test_resuming_and_setting_epochs_do_not_warn(server):
    stream = dataset(server)
    for epoch in (0, 0, 1):
        stream.set_epoch(epoch)
        steps(stream, 2)
    stream.set_epoch(2)
    *_, last = itertools.islice(stream, 2)
    stream.load_state_dict(last.resume_state)
    assert steps(stream, 1)[0] not in last.indices


@pytest.mark.parametrize("make", [V2VStreamDataset, V2VStreamDataset.local])
def test_a_mistyped_argument_is_named_with_the_nearest(make):
    with pytest.raises(UsageError, match=r"^no argument 'batchsize' \(did you mean 'batch_size'\?\); known: "):
        make("tcp://127.0.0.1:1", batchsize=4)


# --- closing ----------------------------------------------------------------------------------------------------------


def test_a_closed_dataset_raises_on_use_and_still_has_its_state(server):
    with dataset(server) as stream:
        batches = iter(stream)
        state = next(batches).resume_state
    for _ in range(2):
        with pytest.raises(UsageError, match=r"this dataset is closed: .* with block"):
            next(iter(stream))
    for use in (iter, len, lambda it: it.set_epoch(1), lambda it: it.load_state_dict(state), lambda it: next(batches)):
        with pytest.raises(UsageError, match="this dataset is closed"):
            use(stream)
    assert stream.state_dict() == state
    stream.close()
    server.until_all_left()
