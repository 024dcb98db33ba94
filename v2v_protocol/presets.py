"""Recipes by name, each stated as its changes to the fields' defaults, which are those of the paper; and presets of the
stream's other settings.

:data:`v2v_protocol.recipe.PRESETS` holds the recipes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

DEFAULT_PRESET = "paper"

PRESET_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # Ablation "-F": one draw of the thresholds per video, the same in every epoch.
    "paper-fixed-thresholds": {"threshold_source": "video"},
    # Ablation "LDR": contrast raised, then clipped.
    "paper-contrast": {"contrast_probability": 0.8},
    # EVFlowNet: the frame before the first target frame, for pseudo flow.
    "paper-flow": {"lead_frames": 1},
    # ERAFT: that frame, and one more voxel grid before the first.
    "paper-eraft": {"lead_frames": 1, "lead_voxels": 1},
    # The paper's pixel without noise, hot pixels or pauses: for tests and for viewing.
    "noise-free": {
        "noise_sigma": (0.0, 0.0),
        "hot_pixel_share": (0.0, 0.0),
        "hot_pixel_sigma": (0.0, 0.0),
        "pause_probability": 0.0,
    },
    # What v2e (Hu et al. 2021) calls `clean`: thresholds 0.2 with a deviation of 0.02, nothing else.
    "clean": {
        "threshold": (0.2, 0.2),
        "threshold_ratio": (1.0, 1.0),
        "threshold_mismatch_sigma": (0.1, 0.1),
        "noise_sigma": (0.0, 0.0),
        "hot_pixel_share": (0.0, 0.0),
        "hot_pixel_sigma": (0.0, 0.0),
    },
    # The paper's pixel with a higher dark floor, drawn (docs/effects.md).
    "sensor": {"log_eps": (0.01, 0.2)},
    # A DAVIS346 in ordinary light; docs/effects.md gives the source of each value.
    "davis346": {
        # ln 1.143, its least contrast, to ln 1.5, as far as such cameras are usually set (Gallego et al. 2022).
        "threshold": (0.134, 0.405),
        # 2.1 % of contrast (Lichtsteiner et al. 2008); 0.05 of 0.2 (v2e `noisy`)
        "threshold_mismatch_sigma": (0.1, 0.25),
        "shot_noise_hz": (0.0, 5.0),  # up to v2e's `noisy`
        "leak_hz": (0.05, 0.2),  # around v2e's 0.1; the width is a guess
        "refractory_seconds": (1e-4, 1e-3),  # ESIM's examples 1e-4, v2e's default 5e-4; the upper end is a guess
        "photoreceptor_hz": (30.0, 300.0),  # v2e's `noisy` and its default
        "dead_pixel_share": (0.0, 1e-4),  # a guess
        # Shot noise takes the place of the paper's noise; hot pixels of up to about a hundred events a second: a guess.
        "noise_sigma": (0.0, 0.0),
        "noise_unit": "second",
        "hot_pixel_share": (0.0, 5e-4),
        "hot_pixel_sigma": (0.0, 20.0),
    },
    # Its successor, a DAVIS346 that has run for a while. Numbers are from sources, no fit (docs/effects.md).
    # `gamma` stays that of the videos; for frames that are linear in intensity, as a DAVIS stores them, set it to 1.
    "davis346-running": {
        "start": "triangular",  # a residual that moves as a Brownian motion: where it stands in the long run
        # v2e's logarithm becomes linear below 20 of 255, with the slope of an epsilon of 0.026; half and twice of it.
        "log_eps": (0.013, 0.052),
        "threshold": (0.134, 0.405),  # as davis346
        "threshold_mismatch_sigma": (0.05, 0.16),  # 2.1 % of contrast (Lichtsteiner et al. 2008) at these thresholds
        "rate_draw": "log",  # still scenes of two DAVIS cameras differ by 9 in their rate of noise
        "shot_noise_hz": (0.1, 10.0),  # around those two, 0.44 and 4.06 a pixel, halved by grey light; v2e's `noisy`: 5
        "leak_hz": (0.05, 0.2),  # around v2e's 0.1
        "refractory_seconds": (1e-4, 1e-3),  # as davis346
        "photoreceptor_hz": (300.0, 3000.0),  # v2e's default; the bandwidth in bright light of Lichtsteiner et al. 2008
        "dead_pixel_share": (0.0, 1e-4),  # a guess, as davis346
        "noise_sigma": (0.0, 0.0),
        "noise_unit": "second",
        "hot_pixel_share": (0.0, 5e-4),  # a guess, as davis346
        "hot_pixel_sigma": (0.0, 20.0),
    },
}

STREAM_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "exact": {"samples_per_decode": 1},
    "balanced": {"samples_per_decode": 2},
    "fast": {"samples_per_decode": 4},
    "natural": {"samples_per_decode": 1, "scene": "auto", "moving_share": 0.75},
    "natural-davis346": {
        "samples_per_decode": 1, "scene": "auto", "moving_share": 0.75, "recipe": "davis346-running",
    },
}  # fmt: skip
"""Spec fields that each preset sets; a recipe by its name. The first three trade accuracy for speed
(`docs/accuracy.md`); "natural" is for videos as they are: what spoils events is left out, and most crops show something
that moves (`docs/scene.md`); "natural-davis346" shows them to a running camera (`docs/effects.md`).
"""
