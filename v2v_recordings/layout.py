"""Define the h5 layout of a recording, which is that of the event_cnn_minimal family and also of V2V.

| path | dtype | meaning |
|---|---|---|
| ``events/ts`` | float64 [N] (float32 is read too) | seconds, not decreasing |
| ``events/xs``, ``events/ys`` | integers [N] | pixels |
| ``events/ps`` | bool or integer [N] | above 0 for a brightness increase |
| ``images/<key>`` | uint8 [H, W] | in the order of their keys |
| ... attribute ``event_idx`` | integer | the first event at the time of the picture or later |
| ... attribute ``timestamp`` | float | seconds, the clock of ``ts`` |
| ... attribute ``event_idx_published`` | integer, optional | ``event_idx`` as the published conversion writes it |
| ``flow/<key>`` | float32 [2, H, W], optional | flow (x, y), px, until the next field; NaN: not known |
| ... attribute ``timestamp`` | float | seconds, the clock of ``ts`` |
| ``flow_dt1/<key>`` | float32 [2, H, W], optional | the field before, by the time at which it ends, for event_flow |
| ``masks/<key>`` | uint8 [H, W], optional | classes, with ``timestamp`` |
| root attributes ``t0``, ``duration`` | float | seconds: the first event, and from it to the last one |
| root attribute ``light`` | text, optional | of the pictures: linear, srgb or the exponent of their light |
| root attribute ``sensor_resolution`` | 2 integers | height, width |
"""

from __future__ import annotations

EVENT_COLUMNS = ("ts", "xs", "ys", "ps")
SUFFIXES = (".h5", ".hdf5")


def image_key(index: int) -> str:
    """Return the path of picture ``index`` in a file that this project writes."""
    return f"images/image{index:09d}"
