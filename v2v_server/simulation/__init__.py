"""A virtual event camera: frames in, voxels out.

:func:`simulate` is for anyone with an array of frames; :func:`simulate_log` for log intensities (high dynamic range,
analytic scenes); :func:`simulate_clip` is what the server worker calls. The pixel model is in ``v2v_protocol.recipe``.

    draw.py       from a recipe to one camera and its view
    view.py       what the camera sees of the picture: resize, crop, flip, contrast
    grey.py       frames of any usual kind to grey levels
    intensity.py  from grey level to log intensity and to light
    clip.py       simulating a clip: arguments checked, noise prepared, kernel called
    result.py     what it returns
    pixel.py      the kernel: all pixels, all steps, one pass
    noise.py      its random numbers: the definition
    voxel.py      steps, bins and dtypes: the definition
    effects/      what a camera does beyond the paper's pixel, one file an effect
    precision.py  float32, float64 or a refusal
    variants.py   the compiled forms of the kernels, and having them in time
    vectors.py    what the compiler's language lacks
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v2v_server.simulation.clip import simulate, simulate_clip, simulate_log
    from v2v_server.simulation.result import Voxels

__all__ = ["Voxels", "simulate", "simulate_clip", "simulate_log"]


def __getattr__(name: str) -> Any:
    # The schedule imports draw.py in a process that never simulates; the compiler is loaded on first use only.
    if name in __all__:
        from v2v_server.simulation import clip, result

        return getattr(result if name == "Voxels" else clip, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
