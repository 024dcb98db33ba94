"""Every preset and field that changes bytes gives the bytes of the table, on every way to a sample.

A change that alters any of them alters what every saved stream means: it raises NUMERICS_VERSION, says so in the
changelog, and writes the table again (``make.py``). A later field adds a row.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.digests.clips import zooming
from tests.digests.make import TABLE, Table
from tests.digests.rows import OF_THIS_HOST, PORTABLE, Ways, compared
from tests.oracles.decoded import decode_luma
from v2v_protocol.recipe import PRESETS, STREAM_PRESETS, Recipe
from v2v_protocol.sample import ARRAYS
from v2v_protocol.settings import settings_of
from v2v_protocol.spec import StreamSpec
from v2v_server.video.probe import probe

UNCHANGED = {"exact", "fast"}
"""Presets of the number of samples per decode, as "balanced"."""
SAME_BYTES = {"on_bad_video", "tolerance"}


@pytest.fixture(scope="module")
def ways(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ways]:
    opened = Ways(tmp_path_factory.mktemp("digests"))
    with pytest.MonkeyPatch.context() as patch:
        # Several pieces of the cache for most samples, and none of a whole video.
        patch.setattr("v2v_server.store.cache.piece_frames", lambda rows, width_px: 16)
        yield opened
    opened.close()


def test_the_table_has_every_preset_and_array() -> None:
    rows = Table(TABLE).rows
    assert rows.keys() == PORTABLE.keys()
    assert rows.keys() >= PRESETS.keys() | STREAM_PRESETS.keys() - UNCHANGED
    assert {array for row in rows.values() for array in row["arrays"]} == ARRAYS.keys()


def test_every_field_that_changes_bytes_has_a_row() -> None:
    streams = [row.stream for row in (PORTABLE | OF_THIS_HOST).values()]
    for kind, rows in ((StreamSpec, streams), (Recipe, [stream.recipe for stream in streams])):
        for name, setting in settings_of(kind).items():
            assert name in SAME_BYTES or any(getattr(row, name) != setting.default for row in rows), name


def test_the_videos_decode_to_the_very_luma(ways: Ways) -> None:
    """Without this, a digest could not tell an encoder's change from ours."""
    facts = probe(ways.videos / "a.mkv")
    frames = decode_luma(ways.videos / "a.mkv", facts.index, 0, facts.frames).frames
    np.testing.assert_array_equal(frames, zooming(facts.frames)[0])


@pytest.mark.parametrize("name", PORTABLE)
def test_each_way_makes_the_bytes_of_the_table(name: str, ways: Ways) -> None:
    expected = Table(TABLE).row(name)
    for way, make in ways.of(PORTABLE[name]).items():
        differences = compared(expected, make(PORTABLE[name]))
        assert not differences, f"{name}, from {way}: {'; '.join(differences)}"


def test_a_difference_names_array_element_and_both_values(ways: Ways) -> None:
    expected = Table(TABLE).row("paper")
    arrays = {name: array.copy() for name, array in expected[0].items()}
    arrays["frames"][1, 0, 0, 2, 3] ^= 4
    draws = [dict(draw) for draw in expected[1]]
    draws[2]["crop_top_px"] = 77
    was, now = (each["frames"][1, 0, 0, 2, 3] for each in (expected[0], arrays))
    frames, draw = compared(expected, (arrays, draws))
    assert frames == f"frames[1, 0, 0, 2, 3] is {now}, not {was} (1 of {arrays['frames'].size} differ)"
    assert draw == f"crop_top_px of sample 2 is 77, not {expected[1][2]['crop_top_px']}"
    other = {**arrays, "voxels": arrays["voxels"].astype(np.int16)}
    assert "voxels is int16[" in compared(expected, (other, draws))[0]
