"""A virtual event camera: frames in, voxels out.

:func:`simulate` takes any array of frames; :func:`simulate_log` takes log intensities (high dynamic range, analytic
scenes); the server worker calls :func:`simulate_clip`. The pixel model is in ``v2v_protocol.recipe``.

    draw.py           from a recipe to one camera and its view
    view.py           the camera's view of the picture: resize, crop, flip, contrast
    intensity.py      from grey level to log intensity and to light
    clip.py           simulate a clip: check arguments, frames of any kind to grey levels
    kernels.py        call the kernel that a clip needs; its result
    continued.py      a clip of any length, piece by piece
    pixel.py          the paper's kernel: all pixels, all steps, one pass
    noise.py          its random numbers: the definition
    voxel.py          steps, segments, bins and dtypes: the definition
    effects/          effects beyond the paper's pixel, one file per effect, and the general kernel
    representations/  arrays made of events, one file per array
    precision.py      float32, float64 or a refusal; which compiled form of the kernels
    forms.py          load these forms
    vectors.py        functions that the compiler's language lacks
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v2v_server.simulation.clip import simulate, simulate_clip, simulate_log
    from v2v_server.simulation.kernels import Voxels

__all__ = ["Voxels", "simulate", "simulate_clip", "simulate_log"]


def __getattr__(name: str) -> Any:
    # The schedule imports draw.py in a process that never simulates; the compiler is loaded on first use only.
    if name in __all__:
        from v2v_server.simulation import clip

        return getattr(clip, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
