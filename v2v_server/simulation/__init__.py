"""A virtual event camera: frames in, voxels out.

:func:`simulate` is for anyone with an array of frames; :func:`simulate_log` for log intensities (high dynamic range,
analytic scenes); ``simulate_clip`` in ``clip.py`` is what the server worker calls. The pixel model is in
``v2v_protocol.recipe``, the definition of a bin in ``voxel.py``, that of the noise in ``noise.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v2v_server.simulation.clip import Voxels, simulate, simulate_clip, simulate_log, warm_up

__all__ = ["Voxels", "simulate", "simulate_clip", "simulate_log", "warm_up"]


def __getattr__(name: str) -> Any:
    # The schedule imports draw.py in a process that never simulates; the compiler is loaded on first use only.
    if name in __all__:
        from v2v_server.simulation import clip

        return getattr(clip, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
