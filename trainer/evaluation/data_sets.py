"""Define the paper's four data sets: their sequences, and which seconds of each are scored.

Seconds count from the first picture of the raw recording. A picture at the end of a time range does not belong to it.
Sequences of EVAID that the paper leaves out (blocks, umbrella, room2) are not listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

TimeRange = tuple[float, float]


@dataclass(frozen=True)
class DataSet:
    """Hold sequences that are averaged together.

    Attributes:
        name: as in the paper's tables.
        folder: subfolder of the data folder.
        time_ranges: first and last second to score, by sequence; None scores all of it.
        published_shift: number of pictures by which the released conversion moves the time ranges later.
    """

    name: str
    folder: str
    time_ranges: Mapping[str, TimeRange | None]
    published_shift: int = 0


HQF = (
    "bike_bay_hdr", "boxes", "desk", "desk_fast", "desk_hand_only", "desk_slow", "engineering_posters",
    "high_texture_plants", "poster_pillar_1", "poster_pillar_2", "reflective_materials", "slow_and_fast_desk",
    "slow_hand", "still_life",
)  # fmt: skip

DATA_SETS = {
    data_set.name: data_set
    for data_set in (
        DataSet("HQF", "hqf", dict.fromkeys(HQF)),
        DataSet(
            "EVAID",
            "evaid",
            {
                **dict.fromkeys(
                    ("ball", "box", "building", "room1", "sculpture", "toy", "traffic", "wall"), (0.0, 5.0)
                ),
                "bear": (0.0, 2.7),
                "outdoor": (0.0, 1.4),
                "playball": (25.0, 30.0),
            },
            # The released conversion also takes the picture at the end, and then drops the first one.
            published_shift=1,
        ),
        DataSet(
            "IJRR",
            "ijrr",
            {
                **dict.fromkeys(
                    ("boxes_6dof", "calibration", "dynamic_6dof", "poster_6dof", "shapes_6dof"), (5.0, 20.0)
                ),
                "office_zigzag": (5.0, 12.0),
                "slider_depth": (1.0, 2.5),
            },
        ),
        DataSet(
            "MVSEC",
            "mvsec",
            {
                **dict.fromkeys(("indoor_flying1", "indoor_flying2", "indoor_flying3"), (10.0, 70.0)),
                "indoor_flying4": (10.0, 19.8),
                "outdoor_day1": (0.0, 60.0),
                "outdoor_day2": (100.0, 160.0),
            },
        ),
    )
}
"""Data sets by their names in the paper's tables."""
