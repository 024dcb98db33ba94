"""Optical flow between the target frames of a clip, estimated by classic methods on the CPU.

A field f on the grid of picture A says where what A shows has gone in picture B: B(x + f(x)) = A(x), pixels, (x, y), x
to the right and y down. Forward flow lies on the grid of the earlier picture, backward flow on that of the later one.
"""

from v2v_server.flow.clip import FlowClip, flow_for, flow_window, view_part
from v2v_server.flow.settings import DIRECTIONS, FlowSettings

__all__ = ["DIRECTIONS", "FlowClip", "FlowSettings", "flow_for", "flow_window", "view_part"]
