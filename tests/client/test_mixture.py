"""Mix datasets of toy servers: order, state, ranks, loader workers, and what is refused."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.client.fake_server import SPEC, FakeServer, expected
from trainer.config_file import load_config
from v2v_client import RepeatedSamplesWarning, ServerLost, StateMismatch, UsageError, V2VStreamDataset
from v2v_client.mixture import MixtureConsumer
from v2v_client.position import StreamIdentity
from v2v_protocol.spec import StreamSpec


@pytest.fixture
def servers() -> Iterator[tuple[FakeServer, FakeServer]]:
    with FakeServer(sequences=83) as one, FakeServer(sequences=43) as other:
        one.catalogue, other.catalogue = "one", "other"
        yield one, other


def dataset(server: FakeServer, **options: Any) -> V2VStreamDataset:
    options = {"batch_size": 4, "seed": 5, "rank": 0, "world_size": 1, "timeout_seconds": 60.0} | options
    return V2VStreamDataset(server.address, **options)


def mixed(servers: Any, weights: Any = (0.7, 0.3), seed: int = 1, **options: Any) -> V2VStreamDataset:
    members = [dataset(server, **options) for server in servers]
    return V2VStreamDataset.mix(dict(zip(members, weights, strict=True)), seed)


def places(batches: Any) -> list[tuple[int, str, int]]:
    return [(each.epoch, each.provenance[0].id.catalogue_digest, each.indices[0]) for each in batches]


@given(st.data())
def test_each_member_has_its_share_of_any_beginning(data: st.DataObject) -> None:
    lengths = data.draw(st.lists(st.integers(1, 200), min_size=2, max_size=4))
    parts = data.draw(st.lists(st.integers(0, 9), min_size=len(lengths), max_size=len(lengths)).filter(any))
    weights = [part / sum(parts) for part in parts]
    stream = StreamIdentity({"members": [{"sequences": length * 6} for length in lengths]}, "", "", 1, 0)
    consumer = MixtureConsumer(3, 1, 2, data.draw(st.integers(0, 2**64 - 1)), [weights])
    order = consumer.order(stream, data.draw(st.integers(0, 2**32 - 1)))
    shares = np.bincount(order, minlength=len(lengths))
    assert all(share <= length for share, length in zip(shares, lengths, strict=True))
    assert any(share == length for share, length in zip(shares, lengths, strict=True))
    assert [share > 0 for share in shares] == [weight > 0 for weight in weights]
    for number, share in enumerate(shares):
        due = np.arange(1, len(order) + 1) * share / len(order)
        assert np.abs(np.cumsum(order == number) - due).max() <= 1 + len(lengths) * share / len(order)


ORDERS = [[0, 1, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 0, 1, 0, 1], [0, 0, 1, 0, 1, 0, 0, 0, 1, 0, 0]]


def test_the_order_is_pinned() -> None:
    """Philox (Salmon et al. 2011) and IEEE arithmetic: the order is the same on every host and with every NumPy."""
    stream = StreamIdentity({"members": [{"sequences": 8}, {"sequences": 8}]}, "", "", 1, 0)
    consumer = MixtureConsumer(1, 0, 1, 2**64 - 1, [[0.5, 0.5], [0.75, 0.25]])
    assert consumer.order(stream, 0).tolist() == ORDERS[0]
    assert consumer.order(stream, 1).tolist() == consumer.order(stream, 1).tolist() == ORDERS[1]
    assert np.bincount(consumer.order(stream, 2**32 - 1)).tolist() == [8, 3]


def test_the_batches_are_those_of_the_members_in_another_order(servers: tuple[FakeServer, FakeServer]) -> None:
    mixture = mixed(servers)
    assert len(mixture) == 29
    batches = list(mixture)
    for server in servers:
        alone = list(dataset(server))
        own = [each for each in batches if each.provenance[0].id.catalogue_digest == server.catalogue]
        assert places(own) == places(alone)[: len(own)]
        for batch in own:
            np.testing.assert_array_equal(batch.voxels[1], expected("voxels", 5, 0, batch.indices[1]))
    assert len(batches) == len(mixture) == 29
    assert mixture.epoch == 1
    assert places(mixture) != places(batches)
    assert places(mixed(servers)) == places(batches)
    assert places(mixed(servers, seed=2)) != places(batches)


def test_weights_of_each_epoch(servers: tuple[FakeServer, FakeServer]) -> None:
    mixture = mixed(servers, ([1, 0.5], [0, 0.5]))
    assert [(each, len(list(mixture))) for each in (20, 20, 20)] == [(20, 20), (20, 20), (20, 20)]
    mixture.set_epoch(0)
    assert {each[1] for each in places(mixture)} == {"one"}
    assert {each[1] for each in places(mixture)} == {"one", "other"}


@pytest.mark.parametrize("workers", [0, 2])
def test_a_state_continues_with_any_number_of_loader_workers(
    servers: tuple[FakeServer, FakeServer], workers: int
) -> None:
    servers[0].snapshot = 7
    mixture = mixed(servers)
    loader = DataLoader(mixture, batch_size=None, num_workers=workers)
    whole = list(loader)
    following = list(loader)
    assert places(whole) == places(mixed(servers))
    assert places(following) == places(mixed(servers, seed=1, epoch=1))
    saved = json.loads(json.dumps(whole[10].resume_state))
    assert saved["quarantine"] == [7, 0]
    assert (saved["epoch"], saved["position"] > 0) == (0, True)
    assert (whole[-1].resume_state["epoch"], whole[-1].resume_state["position"]) == (1, 0)
    for others in (0, 2):
        again = mixed(servers)
        again.load_state_dict(saved)
        assert places(DataLoader(again, batch_size=None, num_workers=others)) == places(whole[11:])
        assert again.epoch == 1
        assert {hello.quarantine for hello in servers[0].hellos[-1:]} == {7}


def test_the_state_dict_after_each_batch_and_a_pass_left_early(servers: tuple[FakeServer, FakeServer]) -> None:
    mixture = mixed(servers)
    whole, states = [], [mixture.state_dict()]
    for batch in mixture:
        whole.append(batch)
        states.append(mixture.state_dict())
    assert [each.resume_state for each in whole] == states[1:]
    again = mixed(servers)
    again.load_state_dict(states[5])
    batches = iter(again)
    assert places(next(batches) for _ in range(3)) == places(whole[5:8])
    with pytest.warns(RepeatedSamplesWarning):
        assert places(again) == places(whole[5:])


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")
def test_a_stateful_loader_continues_each_of_its_workers(servers: tuple[FakeServer, FakeServer]) -> None:
    whole = places(mixed(servers))
    for count in (7, 29):
        loader = StatefulDataLoader(mixed(servers), batch_size=None, num_workers=2)
        batches = iter(loader)
        assert places(next(batches) for _ in range(count)) == whole[:count]
        saved = loader.state_dict()
        del batches
        loader = StatefulDataLoader(mixed(servers), batch_size=None, num_workers=2)
        loader.load_state_dict(saved)
        assert places(loader) == whole[count:]
        assert places(loader) == places(mixed(servers, epoch=1))


def test_ranks_take_batches_of_the_same_member_at_the_same_time(servers: tuple[FakeServer, FakeServer]) -> None:
    ranks = [list(mixed(servers, rank=rank, world_size=2, batch_size=2)) for rank in (0, 1)]
    first, second = map(places, ranks)
    assert [(epoch, member, index + 1) for epoch, member, index in first] == second
    assert ranks[1][3].resume_state == ranks[0][3].resume_state
    whole = places(mixed(servers))
    assert first == whole


def test_a_new_epoch_may_have_another_order_but_the_middle_of_one_may_not(
    servers: tuple[FakeServer, FakeServer],
) -> None:
    whole = list(mixed(servers))
    for changed in (mixed(servers, (0.5, 0.5)), mixed(servers, batch_size=2)):
        with pytest.raises(StateMismatch, match=r"the state is of 2 mixed datasets with .*; give the same"):
            changed.load_state_dict(whole[3].resume_state)
        changed.load_state_dict(whole[-1].resume_state)
        assert changed.epoch == 1
        assert next(iter(changed)).epoch == 1
    with pytest.raises(StateMismatch, match="seed: the state has 1, this dataset 2"):
        mixed(servers, seed=2).load_state_dict(whole[3].resume_state)


def test_a_state_of_other_datasets_is_refused(servers: tuple[FakeServer, FakeServer]) -> None:
    saved = next(iter(mixed(servers))).resume_state
    swapped = mixed(servers[::-1])
    swapped.load_state_dict(saved)
    with pytest.raises(StateMismatch, match=r"catalogue_digest: the saved state has one, .* has other"):
        next(iter(swapped))
    with pytest.raises(StateMismatch, match="voxel_dtype int16 / int8"):
        mixed(servers, voxel_dtype="int16").load_state_dict(saved)
    with pytest.raises(StateMismatch, match="of 2 mixed datasets"):
        mixed(servers[:1], (1,)).load_state_dict(saved)
    with pytest.raises(StateMismatch, match="of 0 mixed datasets"):
        mixed(servers).load_state_dict(next(iter(dataset(servers[0], seed=1))).resume_state)
    with pytest.raises(StateMismatch, match="the state is of mixed datasets"):
        dataset(servers[0], seed=1).load_state_dict(saved)


@pytest.mark.parametrize(
    "weights", [(0.7, 0.2), (0.7, 0.4), (1.5, -0.5), (0, 0), (float("nan"), 1), ("a", 1), ([], 1), ([0.5, 0.4], 0.5)]
)
def test_weights_that_are_no_shares_are_refused(servers: tuple[FakeServer, FakeServer], weights: Any) -> None:
    with pytest.raises(UsageError, match=r"mix: weights \[.*\] in epoch [01]: give shares from 0 to 1"):
        mixed(servers, weights)


def test_datasets_that_do_not_fit_together_are_refused(servers: tuple[FakeServer, FakeServer]) -> None:
    one, other = servers
    for name, value in (("batch_size", 8), ("arrays", ("voxels",)), ("world_size", 2)):
        with pytest.raises(UsageError, match=rf"mix: the datasets have {name} = .*; give all the same"):
            V2VStreamDataset.mix({dataset(one): 0.5, dataset(other, **{name: value}): 0.5})
    with pytest.raises(UsageError, match=r"mix: weights \[\]"):
        V2VStreamDataset.mix({})
    other.spec = StreamSpec(recipe=SPEC.recipe.replace(bins=3))
    with pytest.raises(UsageError, match=r"mix: samples differ in form, .*127\.0\.0\.1.*give recipes of one size"):
        next(iter(mixed(servers)))


NO_MIXTURES: list[tuple[Any, str]] = [
    (lambda one, other: [one, other], "give a dict of datasets with their weights"),
    (lambda one, other: (one, other), "give a dict"),
    (lambda one, other: one, "give a dict"),
    (lambda one, other: {}, r"weights \[\]"),
    (lambda one, other: None, "give a dict"),
    (lambda one, other: {"tcp://127.0.0.1:9": 0.5, other: 0.5}, r"give V2VStreamDataset\('tcp://127.0.0.1:9', ...\)"),
    (lambda one, other: {one: 0.5, 3: 0.5}, "3 is no dataset to mix"),
    (lambda one, other: {V2VStreamDataset.mix({one: 1}): 0.5, other: 0.5}, "is no dataset to mix"),
    (lambda one, other: {one: 0.5, copy.copy(one): 0.5}, "is a member twice"),
    (lambda one, other: {one: 0.5, V2VStreamDataset("tcp://127.0.0.1:8"): 0.5}, "is a member twice"),
    (lambda one, other: {one: True}, "shares from 0 to 1"),
    (lambda one, other: {one: "1"}, "shares from 0 to 1"),
    (lambda one, other: {one: {0: 1}}, "shares from 0 to 1"),
    (lambda one, other: {one: torch.tensor(0.5), other: 0.4}, "shares from 0 to 1"),
]


@pytest.mark.parametrize("number", range(len(NO_MIXTURES)))
def test_what_is_no_mixture_is_refused_in_words(number: int) -> None:
    weights, words = NO_MIXTURES[number]
    one, other = V2VStreamDataset("tcp://127.0.0.1:8"), V2VStreamDataset("tcp://127.0.0.1:9")
    with pytest.raises(UsageError, match=words):
        V2VStreamDataset.mix(weights(one, other))


def test_weights_are_numbers_of_every_type() -> None:
    one, other = V2VStreamDataset("tcp://127.0.0.1:8"), V2VStreamDataset("tcp://127.0.0.1:9")
    mixture = V2VStreamDataset.mix({one: np.float32(0.75), other: torch.tensor([0.25, 0.25])}, seed=np.int64(1))
    assert mixture._settings()["weights"] == [[0.75, 0.25], [0.75, 0.25]]


EDITS = [
    None,
    0,
    -1,
    2**70,
    1.5,
    "",
    "x",
    b"x",
    True,
    [],
    [1],
    [[]],
    [{}],
    {},
    {"a": 1},
    {"members": 3},
    {"members": [3]},
]


def edited(value: Any) -> Iterator[Any]:
    """Yield copies of plain values, each with one part that is another, missing or more."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield {name: each for name, each in value.items() if name != key}
            yield from (value | {key: other} for other in edited(part))
        yield value | {"other": 1}
    elif isinstance(value, list | tuple):
        for place, part in enumerate(value):
            yield [*value[:place], *value[place + 1 :]]
            yield from ([*value[:place], other, *value[place + 1 :]] for other in edited(part))
    yield from EDITS


def test_an_edited_state_is_refused_in_words(servers: tuple[FakeServer, FakeServer]) -> None:
    mixture, alone = mixed(servers), dataset(servers[0])
    states = [next(iter(each)).resume_state for each in (mixture, alone)]
    for each, state in zip((mixture, alone), states, strict=True):
        for number, wrong in enumerate(edited(state)):
            expected = StateMismatch if isinstance(wrong, dict) else UsageError
            try:
                each.load_state_dict(wrong)
                len(each)
            except expected:
                continue
            except Exception as error:  # noqa: BLE001 - any other
                pytest.fail(f"edit {number} of {each!r} gives {error!r}")


def test_a_lost_server_and_a_small_member_are_named(servers: tuple[FakeServer, FakeServer]) -> None:
    one, other = servers
    other.sequences = 3
    with pytest.raises(UsageError, match=f"mix: {other.address} gives 3 sequences, and a batch of all ranks needs 4"):
        next(iter(mixed(servers)))
    other.sequences, other.mute = 43, True
    with pytest.raises(ServerLost, match=other.address):
        list(V2VStreamDataset.mix({dataset(one): 0.7, dataset(other, timeout_seconds=0.5): 0.3}))
    with mixed(servers) as mixture:
        assert one.address in repr(mixture)
    with pytest.raises(UsageError, match="closed"):
        iter(mixture)


def test_the_page_runs_and_its_configuration_is_valid(servers: tuple[FakeServer, FakeServer], tmp_path: Path) -> None:
    page = Path(__file__, "../../../docs/guides/mix.md").resolve().read_text("utf-8")
    code, configuration = re.findall(r"```(?:python|yaml)\n(.*?)```", page, re.DOTALL)
    for port, server in (("5555", servers[0]), ("5556", servers[1])):
        code = code.replace(f"tcp://127.0.0.1:{port}", server.address)
    ran: dict[str, Any] = {}
    exec(code, ran)
    assert (ran["saved"]["epoch"], ran["saved"]["position"]) == (1, 0)
    (tmp_path / "mine.yaml").write_text(configuration)
    mixed_in = load_config(str(tmp_path / "mine.yaml")).stream.mixed
    assert [weight for _, weight in mixed_in.values()] == [0.7, 0.3]
