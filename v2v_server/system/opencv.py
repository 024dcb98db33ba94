"""OpenCV, imported on first use.

A worker whose samples have no flow and are not resized does not need OpenCV, and starts without its 30 MB. A module
that uses a part of OpenCV at import time, as a default value or a constant, would load it for all: use ``cv2.NAME``
inside functions only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import cv2
else:

    class _OpenCV:
        def __getattr__(self, name: str) -> Any:
            import cv2

            value = getattr(cv2, name)
            setattr(self, name, value)  # the next access does not call this function
            return value

    cv2 = _OpenCV()

__all__ = ["cv2"]
