"""Upper bounds of what a pixel can do in a clip."""

from __future__ import annotations

SMALLEST_THRESHOLD_SHARE = 0.25
"""Lower limit of a pixel's threshold under mismatch, as a share of the nominal threshold."""
LARGEST_NORMAL = 6.56
"""No noise deviates by more standard deviations (``v2v_server.simulation.noise``)."""
LARGEST_EVENTS = 2.0**49
"""Largest number of events of a pixel in a clip. With more, float64 no longer resolves a threshold."""


def pixel_thresholds(smallest: float, largest: float, mismatch_sigma: float) -> tuple[float, float]:
    """Return the limits of any pixel's threshold, for nominal thresholds between two values."""
    spread = LARGEST_NORMAL * mismatch_sigma
    return smallest * max(1.0 - spread, SMALLEST_THRESHOLD_SHARE), largest * (1.0 + spread)


def most_events(steps: int, log_ends: tuple[float, float], thresholds: tuple[float, float], noise_sum: float) -> float:
    """Return an upper bound of the events that one pixel can fire in a clip; it determines the arithmetic that is
    needed.

    ((steps + 1) (largest threshold + range of L) + largest noise and hot drift of all steps + largest |L|), in units of
    the smallest threshold: no step changes dL by more, and the start and the rounding of L count as one step more.

    Args:
        steps: differences between frames, or segments of them.
        log_ends: smallest and largest log intensity L.
        thresholds: smallest and largest contrast threshold, log units.
        noise_sum: standard deviations of noise and of hot drift, and the leak, summed over the steps, log units.
    """
    low, high = log_ends
    change = (steps + 1) * (max(thresholds) + (high - low)) + LARGEST_NORMAL * noise_sum
    return (change + max(abs(low), abs(high))) / min(thresholds)
