"""Scene statistics: what an analysis finds in clips of known content, and how the index keeps it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage import data

from tests.clips import damaged, panned_luma, write_clip
from tests.pieces import pieces, shots
from tests.server.corpus.failing_storage import failing_opens
from v2v_protocol.errors import CorpusError, ProtocolError, UsageError
from v2v_server.corpus import probe as collect
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.scenes.analysis import analyse
from v2v_server.corpus.scenes.scene import (
    CHANGE,
    CLIPPED,
    COLUMNS,
    CONTRAST,
    DARK,
    FLICKER,
    MOST_ANALYSED_FRAMES,
    MOTION,
    NO_BARS,
    NOISE,
    SEGMENT_FRAMES,
    UNKNOWN,
    Flag,
    Pieces,
    Scene,
    Sides,
    clip_pieces,
    firsts_of,
)  # fmt: skip
from v2v_server.corpus.scenes.stretches import change_of, duplicated, halt_before, pattern_of, runs_of
from v2v_server.corpus_words import notes_of
from v2v_server.system.isolate import run_twice
from v2v_server.video.rows import Rows

Luma = npt.NDArray[np.uint8]


def pan(frames: int, right_px: int, height: int = 96, width: int = 160) -> Luma:
    return panned_luma(frames, height, width, step=(0, right_px))


def other(frames: int, right_px: int = 1, height: int = 96, width: int = 160) -> Luma:
    """A pan over another photograph."""
    photo = np.array(data.coffee()[..., 1], np.uint8)  # type: ignore[no-untyped-call]
    columns = (np.arange(frames)[:, None] * right_px + np.arange(width)) % photo.shape[1]
    return photo[100 : 100 + height][:, columns].transpose(1, 0, 2)


@pytest.mark.parametrize("pace_px", [1, 2, 4])
def test_motion_is_in_pixels_a_frame(pace_px: int) -> None:
    motion = analyse(pan(32, pace_px)).values(0, 32)[:, MOTION]
    assert np.median(motion) == pytest.approx(pace_px, rel=0.15)


def test_change_and_contrast_against_their_definitions() -> None:
    luma = pan(20, 2, 64, 96)
    blocks = luma.reshape(20, 8, 8, 12, 8).mean(axis=(2, 4))
    values = analyse(luma).values(0, 20)
    for segment, (low, high) in enumerate(((0, 16), (16, 19))):
        changes = [np.abs(blocks[t] - blocks[max(0, t - 4)]) for t in range(low + 1, high + 1)]
        tiles = np.max(changes, axis=0).reshape(4, 2, 4, 3).max(axis=(1, 3)).ravel()
        assert values[segment, CHANGE] == pytest.approx(tiles, abs=1 / 64)
    assert values[0, CONTRAST] == pytest.approx(max(blocks[t].std() for t in range(16)), abs=1 / 64)


def test_what_changes_little_of_the_picture_is_quiet() -> None:
    """The mean over the tiles decides, for whole segments."""
    corner = np.repeat(pan(1, 0, 96, 128), 40, axis=0)
    corner[:, :24, :32] = other(40, 3, 24, 32)
    scene = analyse(np.concatenate([pan(24, 4, 96, 128), corner]))
    is_quiet = [bool(flags & Flag.QUIET) for _, flags, *_ in scene.pieces.tolist()]
    assert (scene.values(0, 64)[:, CHANGE].mean(axis=1) < 35).tolist() == [False, False, True, True]
    assert np.repeat(is_quiet, np.diff(scene.pieces["end"], prepend=0)).tolist() == [False] * 32 + [True] * 32


@pytest.mark.parametrize(("level", "dark", "clipped"), [(15, 1, 0), (16, 0, 0), (249, 0, 0), (250, 0, 1)])
def test_dark_and_clipped_shares(level: int, dark: float, clipped: float) -> None:
    luma = np.full((5, 40, 64), 100, np.uint8)
    luma[:, :10] = level
    values = analyse(luma).values(0, 5)[0]
    assert values[DARK] == pytest.approx(dark / 4, abs=1e-3)
    assert values[CLIPPED] == pytest.approx(clipped / 4, abs=1e-3)


def test_noise_and_flicker_have_the_strength_they_were_given() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((33, 96, 160), 120.0)
    noisy = np.rint(flat + rng.normal(0, 3.0, flat.shape)).astype(np.uint8)
    # The stillest tenth lies a little below the mean.
    assert analyse(noisy).values(0, 33)[0, NOISE] == pytest.approx(3.0, rel=0.15)
    flickering = (flat + np.where(np.arange(33) % 2, 4, 0)[:, None, None]).astype(np.uint8)
    assert analyse(flickering).values(0, 33)[0, FLICKER] == pytest.approx(4.0, abs=0.1)


def test_cuts_are_found_where_they_are_in_quick_succession_to_black_and_of_dark_scenes() -> None:
    for at in (1, 2, 7, 16, 30, 39):
        assert analyse(np.concatenate([pan(at, 2), other(40 - at, 2)])).shot_boundaries == (at,)
    parts = [pan(12, 1), other(9), pan(11, 1)[:, ::-1], np.zeros((10, 96, 160), np.uint8), pan(12, 1)]
    assert analyse(np.concatenate(parts)).shot_boundaries == (12, 21, 32, 42)
    dark = np.concatenate([pan(12, 1), other(12)]) // 12
    assert analyse(dark).shot_boundaries == (12,)


def test_a_jump_within_a_moving_shot_is_found() -> None:
    """Missing frames of a slow pan leave a picture that is partly the same."""
    luma = pan(80, 1)
    for missing in (20, 30):
        assert analyse(np.concatenate([luma[:25], luma[25 + missing :]])).shot_boundaries == (25,)
    assert analyse(np.concatenate([luma[:25], luma[27:]])).shot_boundaries == ()


def test_what_appears_another_light_flashes_flicker_fades_and_motion_are_no_cuts() -> None:
    still = np.repeat(pan(1, 0), 40, axis=0)
    still[20:, 40:72, 60:110] = 200
    lit = pan(40, 1)
    lit[20:] = np.rint(lit[20:] * 0.6 + 20)
    flash = pan(40, 1)
    flash[20] = np.clip(flash[20].astype(int) * 2 + 60, 0, 255)
    flicker = (pan(40, 1) * np.where(np.arange(40) % 2, 1.0, 0.8)[:, None, None]).astype(np.uint8)
    fade = (pan(40, 1) * np.linspace(1, 0, 40)[:, None, None]).astype(np.uint8)
    starts = np.concatenate([np.repeat(pan(1, 0), 20, axis=0), pan(21, 3)[1:]])
    for luma in (still, lit, flash, flicker, fade, starts, *(pan(60, pace_px) for pace_px in (0, 1, 8, 20))):
        assert analyse(luma).shot_boundaries == ()


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    end = draw(st.integers(0, 300))
    rows = -(-end // SEGMENT_FRAMES)
    ends = [*sorted(draw(st.sets(st.integers(1, end - 1), max_size=6)) if end > 1 else ()), end][: end and None]
    parts = pieces(*((at, draw(st.integers(0, 127)), Sides(*draw(st.sampled_from([NO_BARS, (3, 4, 5, 6)]))))
                     for at in ends))  # fmt: skip
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return Scene(0, end, parts, rng.integers(0, UNKNOWN + 1, (rows, COLUMNS)).astype(np.uint16))


@given(scenes(), st.data())
def test_encoding_and_slices(scene: Scene, data: st.DataObject) -> None:
    back = Scene.from_bytes(scene.to_bytes())
    assert back.to_bytes() == scene.to_bytes()
    assert (back.first, back.end, back.pieces.tobytes()) == (scene.first, scene.end, scene.pieces.tobytes())
    start = data.draw(st.integers(0, 320))
    count = data.draw(st.integers(1, 60))
    part = Scene.from_bytes(scene.slice(start, count).to_bytes())
    low, high = start, min(start + count, scene.end)
    if low < high:
        np.testing.assert_array_equal(part.values(low, high), scene.values(low, high))
        assert set(part.shot_boundaries) >= {cut for cut in scene.shot_boundaries if low < cut < high}
        assert part.sides(low, high) == scene.sides(low, high)
        within = int(np.count_nonzero(scene.frames_from(low, high - low) < high))
        np.testing.assert_array_equal(part.frames_from(low, within), scene.frames_from(low, within))
    else:
        assert not len(part.segments)


@given(st.binary(max_size=60))
def test_what_is_no_scene_is_refused(data: bytes) -> None:
    for content in (data, analyse(pan(1, 0)).to_bytes()[:4] + data):
        with pytest.raises(ProtocolError):
            Scene.from_bytes(content)


def test_a_scene_that_contradicts_itself_is_refused() -> None:
    scene = analyse(pan(40, 1))
    for other_scene in (
        dataclasses.replace(scene, end=60),
        dataclasses.replace(scene, pieces=shots(39)),
        dataclasses.replace(scene, pieces=shots(40, 9, 9)),
        dataclasses.replace(scene, pieces=shots(40, 41)),
        dataclasses.replace(scene, first=3),
        dataclasses.replace(scene, end=MOST_ANALYSED_FRAMES + 1),
    ):
        with pytest.raises(ProtocolError):
            Scene.from_bytes(other_scene.to_bytes())
    with pytest.raises(ProtocolError, match="decompress"):
        Scene.from_bytes(scene.to_bytes()[:-3])


# --- of a corpus ------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "videos"
    write_clip(made / "cut.mkv", np.concatenate([pan(30, 2), other(40)]), codec="ffv1", pixel_format="gray")
    write_clip(made / "whole.mp4", pan(50, 1), gop=50)
    damaged(made / "whole.mp4", made / "broken.mp4", 30)
    return made


@contextmanager
def opened(folder: Path, **settings: object) -> Iterator[Catalogue]:
    settings = {"cache_dir": folder.parent / "cache", "processes": 0, "scene": True} | settings
    catalogue = open_catalogue(folder, **settings)  # type: ignore[arg-type]
    try:
        yield catalogue
    finally:
        catalogue.close()


def test_off_changes_nothing(folder: Path) -> None:
    with opened(folder, scene=False) as before, opened(folder) as with_scenes, opened(folder, scene=False) as after:
        assert before.digest == with_scenes.digest == after.digest
        assert before.videos == after.videos
        assert with_scenes.facts.digest_under("off") == before.facts.digest_under("off") == before.digest
        assert with_scenes.facts.digest_under("auto") != before.digest
        with pytest.raises(UsageError, match="--scene auto"):
            before.facts.digest_under("auto")
        with pytest.raises(CorpusError, match="without statistics"):
            before.scene("cut.mkv")


def test_a_corpus_is_looked_at_once(folder: Path) -> None:
    looked: list[int] = []
    with opened(folder, progress=lambda done, total: looked.append(total)) as first:
        assert looked.count(3) == 6  # probed, then looked at
        assert {video.id: video.pieces for video in first.videos} == {
            "broken.mp4": b"", "cut.mkv": shots(70, 30).tobytes(), "whole.mp4": b"",
        }  # fmt: skip
        # What lies behind the damage is unknown; who is served it finds the same error.
        assert 25 <= first.scene("broken.mp4").end <= 31
        digest = first.scene_digest
    looked.clear()
    with opened(folder, progress=lambda done, total: looked.append(total)) as again:
        assert again.scene_digest == digest
    assert looked == []
    write_clip(folder / "whole.mp4", np.concatenate([pan(20, 1), other(30)]), gop=50)
    with opened(folder, progress=lambda done, total: looked.append(total)) as changed:
        assert looked == [1, 1]
        assert next(video.pieces for video in changed.videos if video.id == "whole.mp4") == shots(50, 20).tobytes()
        assert changed.scene_digest != digest


def test_storage_that_fails_while_a_video_is_looked_at_is_asked_again(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once at once, and else at the next start: otherwise a video would never have had a cut."""
    with opened(folder, scene=False), opened(folder, cache_dir=tmp_path / "other") as undisturbed:
        digest = undisturbed.scene_digest
    monkeypatch.setattr(collect, "run_twice", lambda work, jobs, *_, **__: run_twice(work, jobs, 0))
    left = failing_opens(monkeypatch, cut=2, whole=1)
    with opened(folder) as first:
        assert left == {"cut": 0, "whole": 0}
        assert not any(video.pieces for video in first.videos)
        assert any("cut.mkv" in note for note in notes_of(first))
    with opened(folder) as again:
        assert again.scene_digest == digest


def test_only_the_rows_in_use_are_looked_at(folder: Path) -> None:
    luma = np.concatenate([pan(60, 1, 96), np.repeat(pan(1, 0, 64), 60, axis=0)], axis=1)
    luma[30:, :96] = other(30)
    still = pieces((60, Flag.STILL | Flag.QUIET)).tobytes()
    write_clip(folder / "below.mkv", luma, codec="ffv1", pixel_format="gray")
    for rows, expected in (("full", shots(60, 30).tobytes()), ("0.6:1", still)):
        with opened(folder, rows=Rows.parse(rows)) as catalogue:
            entry = next(video for video in catalogue.videos if video.id == "below.mkv")
            assert entry.pieces == expected


@pytest.mark.slow
def test_processes_look_as_well_as_one(folder: Path, tmp_path: Path) -> None:
    with opened(folder) as one, opened(folder, cache_dir=tmp_path / "other", processes=2) as two:
        assert one.scene_digest == two.scene_digest


# --- pieces -----------------------------------------------------------------------------------------------------------

TELLING = Flag.CUT | Flag.REPEAT | Flag.FADE | Flag.COMBED
SIDES = st.sampled_from([NO_BARS, Sides(2, 4, 0, 0)])


@st.composite
def videos(draw: st.DrawFn) -> tuple[int, Pieces]:
    """Draw the frames of a video and the pieces of the part that was analysed."""
    ends = sorted(draw(st.sets(st.integers(1, 40), max_size=6)))
    drawn = pieces(*((end, draw(st.integers(0, 127)), draw(SIDES)) for end in ends))
    return draw(st.integers(1, 50)), draw(st.sampled_from([drawn, pieces()]))


def by_frame(part: Pieces, first: int) -> list[tuple[int, ...]]:
    """Return flags (a cut at its frame only) and bars of each frame."""
    found = []
    for low, (end, flags, *sides) in zip(firsts_of(part, first).tolist(), part.tolist(), strict=True):
        found += [(flags if frame == low else flags & ~Flag.CUT, *sides) for frame in range(low, end)]
    return found


@given(videos(), st.integers(0, 45), st.integers(1, 20))
def test_clipped_pieces_say_the_same_of_each_frame(drawn: tuple[int, Pieces], start: int, count: int) -> None:
    _, whole = drawn
    seen = by_frame(whole, 0)
    spoilt = any(flags & TELLING or any(sides) for flags, *sides in seen)
    all_frames = [*seen, *[(Flag.UNSEEN if spoilt else 0, *NO_BARS)] * 70]
    assert by_frame(clip_pieces(whole, 0, start, start + count), start) == all_frames[start : start + count]


# --- repeats and stretches --------------------------------------------------------------------------------------------

BLOCKS = 100
MOVING = 64**2 * BLOCKS
"""Sum of squares where each block changes by a grey level."""


def repeats_among(changes: list[int]) -> npt.NDArray[np.bool_]:
    """Return which steps repeat a frame, each of which changes another block."""
    blocks = np.zeros((len(changes) + 1, BLOCKS), np.int64)
    for at, change in enumerate(changes):
        blocks[at + 1 :, at % BLOCKS] += math.isqrt(change)
    return duplicated(changes, halts_of(blocks, changes), BLOCKS)


def halts_of(blocks: npt.NDArray[np.int64], changes: list[int]) -> npt.NDArray[np.bool_]:
    """Return which steps are counted as halts, by a loop over all of them."""
    halts = np.zeros(len(changes), bool)
    for end in range(1, len(changes) + 1):
        count = halt_before([*blocks[max(0, end - 9) : end + 1]], changes[:end], changes[:end])
        halts[end - 1 - count : end - 1] = True
    return halts


@given(st.integers(2, 12), st.integers(0, 11), st.integers(0, 2**32))
def test_one_repeat_in_each_period_is_found_and_named(period: int, offset: int, seed: int) -> None:
    offset, random = offset % period, np.random.default_rng(seed)
    changes = [
        MOVING * int(random.integers(1, 4)) if at % period != offset else int(random.integers(0, MOVING // 25 + 1))
        for at in range(10 * period)
    ]
    flags = repeats_among(changes)
    np.testing.assert_array_equal(flags, np.arange(len(changes)) % period == offset)
    special = {2: "every picture twice", 5: "24 in 30", 6: "25 in 30"}
    assert pattern_of(flags) == special.get(period, f"1 of every {period}")


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param([MOVING] * 20 + [0] * 20 + [MOVING] * 20, id="motion comes to rest and begins"),
        pytest.param(([MOVING] * 10 + [900 * MOVING]) * 6, id="cuts in slow motion"),
        pytest.param([MOVING // 30, 0] * 30, id="below coder noise"),
        pytest.param([MOVING] * 29 + [30 * MOVING, 0] + [MOVING] * 29, id="a keyframe that a coder repeats"),
    ],
)
def test_what_looks_like_a_repeat(changes: list[int]) -> None:
    assert not repeats_among(changes).any()


@pytest.mark.parametrize("repeats", [3, 4])
def test_a_few_repeats_in_a_long_video_may_be_chance(repeats: int) -> None:
    """Their step is an eighth of the others, and the next one makes up for it."""
    changes = [MOVING] * 100
    changes[10 : 10 * (repeats + 1) : 10] = [MOVING // 8] * repeats
    changes[11 : 10 * (repeats + 1) + 1 : 10] = [2 * MOVING] * repeats
    assert repeats_among(changes).sum() == (repeats if repeats >= 4 else 0)


@given(st.integers(0, 59), st.integers(0, MOVING // 12), st.integers(0, 2**32))
def test_a_single_repeat_amid_motion_is_found(place: int, change: int, seed: int) -> None:
    changes = np.random.default_rng(seed).integers(MOVING, 2 * MOVING + 1, 60).tolist()
    changes[place] = change
    expected = [place] if 4 <= place < 56 else []
    assert np.flatnonzero(repeats_among(changes)).tolist() == expected


@given(st.data(), st.lists(st.sampled_from([0, MOVING // 20, MOVING, 3 * MOVING]), min_size=1, max_size=60))
def test_repeats_are_looked_for_in_shots_of_any_length(data: st.DataObject, changes: list[int]) -> None:
    boundaries = sorted(data.draw(st.sets(st.integers(1, len(changes)), max_size=9)))
    halts = np.array(data.draw(st.lists(st.booleans(), min_size=len(changes), max_size=len(changes))), bool)
    flags = duplicated(changes, halts, BLOCKS, boundaries)
    assert flags.shape == halts.shape
    assert not flags[[boundary - 1 for boundary in boundaries]].any()  # a cut repeats nothing


def moved_along(places: list[int]) -> tuple[list[npt.NDArray[np.int64]], list[int]]:
    """Return the blocks of pictures all of which change alike, and their changes."""
    blocks = [np.full((10, 10), 256 * place, np.int64) for place in places]
    return blocks, list(map(change_of, blocks[:-1], blocks[1:]))


@pytest.mark.parametrize(
    ("places", "halts"),
    [
        pytest.param([0, 10, 10, 20], 1, id="a repeat"),
        pytest.param([0, 10, 11, 21], 1, id="a repeat that a coder blends"),
        pytest.param([0, 10, 10, 10, 20], 2, id="two of three"),
        pytest.param([0, *[10] * 8, 20], 7, id="seven repeats"),
        pytest.param([0, 10, 14, 14, 24], 1, id="the next step makes up for it"),
        pytest.param([0, 10, 10, 0], 0, id="a turn"),
        pytest.param([0, 10, 12, 2], 0, id="a turn between two frames"),
        pytest.param([0, 10, 10, 3], 0, id="a turn of uneven speed"),
        pytest.param([0, 10, 15, 25], 0, id="slower, not small"),
        pytest.param([0, 2, 3, 13], 0, id="motion begins"),
        pytest.param([10, 10, 20], 0, id="nothing is known of the step before"),
    ],
)
def test_where_a_picture_halts(places: list[int], halts: int) -> None:
    blocks, changes = moved_along(places)
    assert halt_before(blocks, changes, changes) == halts
    pixels = [max(changes)] * len(changes)
    assert halt_before(blocks, changes, pixels) == 0, "something smaller than a block moves"


@given(st.integers(1, 60), st.integers(-200, 200), st.integers(1, 9))
def test_no_turn_at_constant_acceleration_is_a_halt(pace: int, phase: int, scale: int) -> None:
    blocks, changes = moved_along([scale * (pace * at + phase) ** 2 for at in range(-5, 6)])
    assert not halts_of(np.array(blocks), changes).any()


def to_and_fro(what: str, hertz: float, size: float, reach: float, frames: int = 60, rate: float = 30.0) -> Luma:
    """Return something that swings, flickers or turns over a photograph, with soft edges, [frames, 72, 104].

    Args:
        size: radius, px; of a metronome half the width of its arm.
        reach: amplitude, px; of a lamp grey levels; of a wheel its radius.
    """
    at = 2 * np.pi * hertz / rate * np.arange(frames)[:, None, None] + 0.4
    row, column = np.mgrid[:72, :104] - np.array([36, 52])[:, None, None]
    scene = pan(1, 0, 72, 104)[0] / 3 + 40.0
    if what == "lamp":
        return np.rint(scene + 80 + reach * np.sin(at) * np.exp(-(row**2 + column**2) / (8 * size**2))).astype(np.uint8)
    if what == "swing":
        shown = size - np.hypot(column - reach * np.sin(at), row - reach / 4 * np.cos(2 * at))
    elif what == "wheel":
        spokes = size - np.abs(np.sin(5 * (np.arctan2(row, column) - at) / 2)) * np.hypot(row, column)
        shown = np.minimum(spokes, reach - np.hypot(row, column))
    else:
        angle = reach / 60 * np.sin(at)
        shown = size - np.abs((36 - row) * np.sin(angle) - column * np.cos(angle))
    share = np.clip(shown + 0.5, 0, 1)
    return np.rint(scene * (1 - share) + 225 * share).astype(np.uint8)


@pytest.mark.parametrize("rate", [24.0, 30.0, 60.0])
@pytest.mark.parametrize(
    ("what", "size", "reach"),
    [
        ("swing", 9, 30),
        ("swing", 3, 36),
        ("lamp", 9, 40),
        ("lamp", 20, 6),
        ("wheel", 3, 30),
        ("metronome", 3, 30),
        ("metronome", 1, 12),
    ],
)
def test_what_swings_flickers_or_turns_loses_no_frame(what: str, size: float, reach: float, rate: float) -> None:
    """At its turns a step is as small as a repeat, but then the picture comes back."""
    lost = {}
    for hertz in (1.0, 2.0, 3.3, 5.0, 7.5, 10.0, 10.66, 12.0):
        kept = analyse(to_and_fro(what, hertz, size, reach, rate=rate)).frames_from(0, 60)
        lost[hertz] = int(np.count_nonzero(kept >= 60))
    assert set(lost.values()) == {0}, lost


@pytest.mark.parametrize("what", ["swing", "lamp", "metronome"])
def test_repeats_of_what_swings_are_found(what: str) -> None:
    luma = to_and_fro(what, 1.0, 9 if what != "metronome" else 3, 30)
    for source in (np.arange(60) * 4 // 5, np.arange(60) // 2, np.arange(60) * 2 // 5):
        flags = np.concatenate([[False], np.diff(source) == 0])
        kept = analyse(luma[source]).frames_from(0, int((~flags).sum()))
        assert np.isin(kept, np.flatnonzero(~flags)).mean() > 0.8


@given(st.lists(st.booleans(), max_size=40), st.integers(1, 5), st.integers(0, 3))
def test_stretches_cover_what_they_say(flags: list[bool], least: int, gap: int) -> None:
    covered = {at for first, end in runs_of(np.array(flags, bool), least, gap) for at in range(first, end)}
    for first, end in runs_of(np.array(flags, bool), least, gap):
        assert end - first >= least
        assert flags[first]
        assert flags[end - 1]
    if least == 1:
        assert covered >= {at for at, flag in enumerate(flags) if flag}
    if gap == 0:
        assert all(flags[at] for at in covered)
