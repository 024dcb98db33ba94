"""Planes: named arrays beside the luma of a store file, each optional, with an entry for every frame.

Each plane is a file here: its name in :data:`PLANE_KINDS`, and there ``PLANE``, a
:class:`~v2v_server.store.planes.plane.Plane`. It knows when a request wants it, how its array is made from a picture,
how it is stored, and what reading it adds to a clip.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib import import_module
from types import MappingProxyType

from v2v_server.store.planes.plane import Plane
from v2v_server.video.decode import Cut
from v2v_server.video.picture import PixelRect

PLANE_KINDS = ("motion", "detail", "chroma")
"""Files of the planes; also the names under which files have them. Those that change what is read come first."""
PLANES: Mapping[str, Plane] = MappingProxyType(
    {name: import_module(f"{__name__}.{name}").PLANE for name in PLANE_KINDS}
)
"""By name."""
OPTIONAL = tuple(name for name, plane in PLANES.items() if plane.serves)
"""Names of the planes that a user may choose to store."""


def whole_cut(count: int, usable: PixelRect, planes: Iterable[str]) -> Cut:
    """Return the cut of whole usable pictures that planes are made from."""
    cut = Cut(count, usable)
    for name in planes:
        cut = PLANES[name].asked(cut)
    return cut
