"""What a consumer chooses about flow."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.flow.methods import METHODS

AUTO = "auto"
DIRECTIONS = ("forward", "backward")
_LARGEST_MARGIN_PX = 16_384


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """How the flow of a clip is made.

    Attributes:
        method: a name of :data:`v2v_server.flow.methods.METHODS`, or "auto": each pair's own motion decides.
        direction: "forward", on the grid of the earlier frame, or "backward", on that of the later one.
        first_voxel: flow of the voxels before this one is not computed but zero (20: the half rule of the temporal
            consistency loss).
        margin_px: estimated on the crop and this much of the picture around it; None: on the whole picture.

    Raises:
        UsageError: a value outside its choices or limits.
    """

    method: str = AUTO
    direction: str = "forward"
    first_voxel: int = 0
    margin_px: int | None = 64

    @classmethod
    def of(cls, spec: StreamSpec) -> FlowSettings:
        """The settings that a stream's spec states."""
        margin_px = None if spec.flow_margin_px < 0 else spec.flow_margin_px
        return cls(spec.flow_method, spec.flow_direction, spec.flow_from, margin_px)

    def __post_init__(self) -> None:
        names = (AUTO, *METHODS)
        if self.method not in names:
            raise UsageError(f"flow method {self.method!r}: choose one of {', '.join(names)}")
        if self.direction not in DIRECTIONS:
            raise UsageError(f"flow direction {self.direction!r}: choose one of {', '.join(DIRECTIONS)}")
        _check_whole("flow first voxel", self.first_voxel, 1_000_000)
        if self.margin_px is not None:
            _check_whole("flow margin", self.margin_px, _LARGEST_MARGIN_PX)


def _check_whole(name: str, value: object, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
        raise UsageError(f"{name} = {value!r}: give a whole number from 0 to {most}")
