"""Optical flow between the target frames of a clip, estimated by classic methods on the CPU.

A field f on the grid of picture A states where each pixel of A is in picture B: B(x + f(x)) = A(x), in pixels, (x, y),
x to the right and y down. Forward flow lies on the grid of the earlier picture, backward flow on that of the later one.

    methods.py   the estimators by name, and how "auto" chooses among them
    clip.py      the flow of a sample: which pictures, which part, and where it is reliable
"""

from v2v_server.flow.clip import FlowClip, FlowSettings, flow_for

__all__ = ["FlowClip", "FlowSettings", "flow_for"]
