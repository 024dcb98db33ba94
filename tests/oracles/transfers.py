"""Encoders of light: ITU-R BT.2100 and ITU-T H.273 in their own direction, from light to signal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]
WHITE_NITS, WHITE_HLG_SCENE = 203.0, (np.exp((0.75 - 0.55991073) / 0.17883277) + 0.28466892) / 12
"""Light of reference white: cd/m2 of PQ, and share of the largest scene light of HLG at 75 % (ITU-R BT.2408)."""


def encode(light: Reals, transfer: str, gamma: float) -> Reals:
    """Return the signal 0 .. 1 of light, where white is 1.

    Args:
        light: 0 or more.
        transfer: a name of ``v2v_server.video.picture.TRANSFERS``, or "" for a gamma.
        gamma: of SDR.
    """
    if transfer == "pq":
        y = (WHITE_NITS * light / 10_000.0) ** 0.1593017578125
        return np.asarray(((0.8359375 + 18.8515625 * y) / (1.0 + 18.6875 * y)) ** 78.84375)
    if transfer == "hlg":
        scene = light * WHITE_HLG_SCENE
        high = 0.17883277 * np.log(np.maximum(12.0 * scene - 0.28466892, 1e-9)) + 0.55991073
        return np.asarray(np.where(scene <= 1 / 12, np.sqrt(3.0 * scene), high))
    if transfer.startswith("log"):
        decades = 2.0 if transfer == "log100" else 2.5
        return np.asarray(1.0 + np.log10(np.maximum(light, 10.0**-decades)) / decades)
    return np.asarray(light if transfer == "linear" else light ** (1.0 / gamma))
