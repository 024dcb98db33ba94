"""Draws pixel.png, the pixel model on one pixel: python docs/pictures/make_pixel.py

The events are those of ``simulate``; the stairs are the level that the pixel remembers, one threshold an event.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.frame import panels
from v2v_pictures.colours import BRIGHTER, DARKER
from v2v_server.simulation import simulate

_THRESHOLD, _BINS, _FRAMES = 0.3, 5, 21
_LOG_EPS = 1e-3


def main() -> None:
    """Writes the picture beside this file."""
    from matplotlib.colors import to_hex

    red, blue = (to_hex(np.array(colour) / 255) for colour in (BRIGHTER, DARKER))
    time = np.arange(_FRAMES)
    grey = np.rint(128 + 90 * np.sin(time * 0.45 - 1.2)).astype(np.uint8)
    counts = simulate(
        grey[:, None, None], threshold_pos=_THRESHOLD, start_residual=0.0, bins=_BINS, log_eps=_LOG_EPS
    ).voxels.reshape(-1)
    log = np.log(_LOG_EPS + (grey / 255) ** 2.2)
    remembered = log[0] + _THRESHOLD * np.concatenate([[0], np.cumsum(counts.astype(float))])
    file = Path(__file__).with_name("pixel.png")
    with panels(file, 2, title="One pixel: from grey levels to a voxel grid", height_inches=4.2) as (left, right):
        left.plot(time, log, "o-", color="black", ms=4, label="log brightness, one dot a frame")
        left.step(time, remembered, where="post", color="grey", label=f"level it remembers, steps of {_THRESHOLD}")
        left.set(xlabel="video frame", ylabel="log(eps + (grey / 255)^2.2)")
        left.set_ylim(log.min() - 0.3, log.max() + 1.5)
        left.legend(loc="upper center", fontsize=9)
        for axes in (left, right):
            axes.set_xticks(range(0, _FRAMES, _BINS))
        right.bar(time[1:], counts, color=[red if count > 0 else blue for count in counts], width=0.8)
        right.axhline(0, color="black", lw=0.8)
        for edge in range(0, _FRAMES, _BINS):
            right.axvline(edge + 0.5, color="grey", lw=0.8, ls="--")
        for grid in range(_FRAMES // _BINS):
            right.text(grid * _BINS + 3, max(counts) + 0.6, f"voxel grid {grid + 1}", ha="center", fontsize=9)
        right.set(xlabel="bin (here one frame each)", ylabel="events: brighter above 0, darker below")
        right.set_ylim(min(counts) - 0.5, max(counts) + 1.3)
        right.yaxis.get_major_locator().set_params(integer=True)


if __name__ == "__main__":
    main()
