"""The oracle of a stream on a real corpus: samples made here and logged as consumers do, with and without faults."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.chaos.consumer import PROFILES
from tests.clips import panned_luma, write_clip
from tests.oracles.stream import Profile, StreamOracle, Verdict, check
from tests.oracles.stream_log import BatchLine, LifeLine, Line, Sighting, sighting
from v2v_protocol.sample import Refusal
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_tools.remake import remake

ASKED = PROFILES[0]
BATCHES = 4


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three clips that give the small profile 11 sequences in all."""
    folder = tmp_path_factory.mktemp("corpus")
    for number, frames in enumerate((90, 64, 90)):
        write_clip(folder / f"{number}.mp4", panned_luma(frames, step=(1, 1 + number)), gop=15)
    return folder


@pytest.fixture(scope="module")
def catalogue(corpus: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    taken_in = open_catalogue(corpus, cache_dir=tmp_path_factory.mktemp("cache"), processes=0)
    yield taken_in
    taken_in.close()


def lines(catalogue: Catalogue, asked: Profile, flipped: int = -1) -> list[Line]:
    """Return a log without faults, apart from a byte of the sample ``flipped``."""
    found: list[Line] = [LifeLine(0, 0.0)]
    for number in range(BATCHES):
        epoch, place = divmod(number, 11 // asked.batch_size)
        samples = []
        for index in range(place * asked.batch_size, (place + 1) * asked.batch_size):
            made = remake(catalogue, asked.stream_spec, seed=asked.seed, epoch=epoch, index=index)
            arrays = {name: np.array(array) for name, array in made.arrays.items()}
            if index == flipped:
                arrays["voxels"].view(np.uint8).reshape(-1)[1234] ^= 1
            samples.append(sighting(arrays, made.provenance))
        found.append(BatchLine(number, epoch, float(number), 0.0, tuple(samples)))
    return found


@pytest.fixture(scope="module")
def honest(catalogue: Catalogue) -> list[Line]:
    return lines(catalogue, ASKED)


def verdict(catalogue: Catalogue, *logs: tuple[Profile, list[Line]]) -> Verdict:
    return check(catalogue, logs, remakes=100, seed=0)


def faults(found: Verdict) -> tuple[int, int, int]:
    summed = found.to_dict()
    return summed["lost"], summed["duplicated"], summed["mismatched"]


def changed(log: list[Line], place: int, **changes: object) -> list[Line]:
    """Return the log with one field of the first sample of line ``place`` changed."""
    line = log[place]
    assert isinstance(line, BatchLine)
    first = dataclasses.replace(line.samples[0], **changes)  # type: ignore[arg-type]
    return [*log[:place], dataclasses.replace(line, samples=(first, *line.samples[1:])), *log[place + 1 :]]


def test_an_honest_log_passes(catalogue: Catalogue, honest: list[Line]) -> None:
    found = verdict(catalogue, (ASKED, honest))
    assert faults(found) == (0, 0, 0)
    assert found.order[0].faultless
    assert (found.sightings, found.remade, found.substituted) == (16, 16, 0)


def test_a_planted_flipped_byte_is_caught(catalogue: Catalogue) -> None:
    flipped = [line for line in lines(catalogue, ASKED, 6) if not isinstance(line, BatchLine) or line.epoch == 0]
    assert faults(verdict(catalogue, (ASKED, flipped))) == (0, 0, 1)


def test_a_flipped_byte_is_caught_without_a_remake_when_it_was_seen_twice(
    catalogue: Catalogue, honest: list[Line]
) -> None:
    again = changed([LifeLine(2, 9.0), *honest[3:]], 1, digest="0" * 64)
    found = check(catalogue, [(ASKED, [*honest, *again])], remakes=0, seed=0)
    assert found.order[0].faultless
    assert found.order[0].repeated == 8
    assert faults(found) == (0, 0, 1)


def test_two_consumers_of_one_stream_are_compared(catalogue: Catalogue, honest: list[Line]) -> None:
    twin = PROFILES[3]
    assert twin.stream == ASKED.stream
    other = lines(catalogue, twin)
    assert faults(verdict(catalogue, (ASKED, honest), (twin, other))) == (0, 0, 0)
    found = check(catalogue, [(ASKED, honest), (twin, changed(other, 1, digest="0" * 64))], remakes=0, seed=0)
    assert found.contradictions == 1


@pytest.mark.parametrize("changes", [{"video": "1.mp4x"}, {"start_frame": 7}, {"candidate": 1}])
def test_a_sample_of_another_place_is_caught(
    catalogue: Catalogue, honest: list[Line], changes: dict[str, object]
) -> None:
    found = check(catalogue, [(ASKED, changed(honest, 1, **changes))], remakes=0, seed=0)
    assert found.misplaced == 1


def test_a_substitute_is_made_again_from_its_own_candidate(catalogue: Catalogue, honest: list[Line]) -> None:
    oracle = StreamOracle(catalogue, ASKED)
    first = honest[1]
    assert isinstance(first, BatchLine)
    blamed = Refusal(first.samples[0].video, None, "a worker was ended by SIGSEGV over it")
    place = _place(oracle, first.samples[0].index)
    seen = oracle.again(0, Sighting(first.samples[0].index, "", *place, 1, (blamed,), 1))
    assert (seen.video, seen.start_frame, seen.candidate, seen.refusals, seen.quarantine) == (*place, 1, (blamed,), 1)
    moved = changed(honest, 1, **{field.name: getattr(seen, field.name) for field in dataclasses.fields(seen)})
    found = check(catalogue, [(ASKED, moved)], remakes=0, seed=0)
    assert (found.substituted, found.remade, faults(found)) == (1, 1, (0, 0, 0))
    wrong = changed(moved, 1, digest="0" * 64)
    assert faults(check(catalogue, [(ASKED, wrong)], remakes=0, seed=0)) == (0, 0, 1)


def _place(oracle: StreamOracle, index: int) -> tuple[str, int]:
    sequence = oracle.sequence(0, index, 1)
    return sequence.video.id, sequence.start_frame
