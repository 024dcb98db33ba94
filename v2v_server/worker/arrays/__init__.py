"""Arrays of a sample that are not made by the kernel: one file for those that share their input.

    frames.py   the frames as the camera sees them, sharp and exposed
    rgb.py      the frames in colour
    flow.py     optical flow, and where it is reliable; the tracks of photographs
    boxes.py    boxes beside the video
    masks.py    class masks beside the video
    context.py  what all of them are made from, :class:`~.context.SampleContext`

An array is a line in ``v2v_protocol.sample.ARRAYS`` (its dtype and shape, and what it needs) and a function that fills
it, in a file that :data:`FILES` names:

    @makes("depth")
    def depth(context: SampleContext, out: npt.NDArray[Any]) -> None:

``docs/extending.md`` shows how to add one. Arrays that are made of events belong to the kernel:
:mod:`v2v_server.simulation.representations`.
"""

from importlib import import_module

FILES = (
    "frames",
    "rgb",
    "flow",
    "boxes",
    "masks",
)
for _name in FILES:
    import_module(f"{__name__}.{_name}")
