"""Log intensity and picture of each transfer and bit depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles import transfers
from v2v_protocol.errors import UsageError
from v2v_server.simulation import simulate, simulate_log
from v2v_server.simulation.intensity import (
    eight_bits,
    light_table,
    linear_light,
    log_table,
    log_table_float64,
    logarithm,
    tone_table,
)
from v2v_server.video.picture import SDR, TRANSFERS, Signal

SIGNALS = [Signal(bits, transfer) for bits in (8, 10, 12) for transfer in ("", *TRANSFERS.values())]


def test_logarithms() -> None:
    x = np.exp(np.linspace(-700.0, 700.0, 100_001))
    np.testing.assert_allclose(logarithm(x), np.log(x), rtol=1e-15, atol=3e-16)
    assert logarithm(np.array([1.0])) == 0.0


@pytest.mark.parametrize("signal", SIGNALS, ids=str)
def test_light_of_each_level(signal: Signal) -> None:
    """The encoder of the standard, written independently, gives the level back; brighter levels are brighter."""
    light = light_table(2.2, signal)
    value = np.arange(signal.white + 1) / signal.white
    np.testing.assert_allclose(transfers.encode(light, signal.transfer, 2.2), value, atol=1e-6)
    assert (np.diff(light) > 0).all()
    for log_eps in (1e-12, 1e-3, 1.0):
        level = log_table_float64(2.2, log_eps, signal)
        np.testing.assert_allclose(level, np.log(log_eps + light), rtol=1e-14, atol=1e-14)
        assert (np.diff(log_table(2.2, log_eps, signal)) >= 0).all()
    np.testing.assert_allclose(linear_light(2.2, 1e-3, signal), np.minimum(light, 1.0), atol=1e-14)


def test_reference_values() -> None:
    """100, 203 and 1000 cd/m2 of PQ (ITU-R BT.2408, table 1), and both parts of HLG."""
    pq, hlg = light_table(2.2, Signal(12, "pq")), light_table(2.2, Signal(12, "hlg"))
    for share, nits in ((0.5081, 100.0), (0.5807, 203.0), (0.7518, 1000.0), (1.0, 10_000.0)):
        assert 203.0 * pq[round(share * 4095)] == pytest.approx(nits, rel=3e-3)
    assert hlg[round(0.75 * 4095)] == pytest.approx(1.0, rel=1e-3)
    assert hlg[round(0.5 * 4095)] / hlg[-1] == pytest.approx(1 / 12, rel=1e-3)


def test_a_picture_shows_what_sdr_would_show() -> None:
    """Up to white, every transfer gives the grey of SDR, within rounding; what is brighter is white."""
    assert (tone_table(2.2, SDR) == np.arange(256)).all()
    for signal in SIGNALS:
        light = light_table(2.2, signal)
        grey = 255.0 * np.minimum(light, 1.0) ** (1 / 2.2)
        assert np.abs(tone_table(2.2, signal) - grey).max() <= 0.5 + 1e-9
    frames = np.arange(1024, dtype=np.uint16).reshape(1, 32, 32)
    assert np.abs(eight_bits(frames, Signal(10, "pq")) - frames * (255 / 1023)).max() <= 0.5


@pytest.mark.slow  # another compiled kernel
@given(
    bits=st.integers(9, 12),
    transfer=st.sampled_from(["", *TRANSFERS.values()]),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=20, deadline=None)
def test_deep_levels_fire_the_events_of_their_log_intensity(bits: int, transfer: str, seed: int) -> None:
    signal = Signal(bits, transfer)
    frames = np.random.default_rng(seed).integers(0, signal.white + 1, (6, 9, 70)).astype(np.uint16)
    camera: dict[str, Any] = {"threshold_pos": 0.3, "noise_sigma": 0.1, "seed": seed}
    made = simulate(frames, bits=bits, transfer=transfer, **camera)
    expected = simulate_log(log_table(2.2, 1e-3, signal)[frames], **camera)
    np.testing.assert_array_equal(made.voxels, expected.voxels)


@pytest.mark.slow
def test_effects_see_the_light_of_deep_levels() -> None:
    """The nearest levels of 12 bits fire almost the same events as those of 8 bits."""
    frames = np.random.default_rng(1).integers(0, 256, (6, 20, 30)).astype(np.uint8)
    deep = np.rint(frames * (4095 / 255)).astype(np.uint16)
    camera: dict[str, Any] = {
        "threshold_pos": 0.3, "shot_noise_hz": 500.0, "photoreceptor_hz": 9.0, "frames_per_second": 25.0
    }  # fmt: skip
    one, other = simulate(frames, **camera).voxels, simulate(deep, bits=12, **camera).voxels
    assert np.abs(one - other).sum() <= 0.03 * np.abs(one).sum()


def test_signals_that_are_refused() -> None:
    deep = np.full((6, 4, 4), 1024, np.uint16)
    for given_signal, words in (
        ({"bits": 17}, "bits = 17"),
        ({"transfer": "srgb"}, "transfer 'srgb'"),
        ({"bits": 10}, "levels up to 1024"),
        ({}, "uint16"),
    ):
        with pytest.raises(UsageError, match=words):
            simulate(deep, threshold_pos=0.2, **given_signal)
