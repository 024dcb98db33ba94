"""Write blurred.png, a frame of a photograph that moves: sharp, exposed for 30 ms, and the events of the same light.

python docs/pictures/make_blurred.py PHOTOGRAPHS
"""

import sys
from pathlib import Path

import numpy as np

from v2v_client import V2VDataset
from v2v_pictures.colours import draw_events, draw_grey
from v2v_pictures.files import write_png

moving = {
    "preset": "worlds-fine", "exposure_seconds": 0.03, "world_speed_px": 300, "threshold": 0.2, "voxels_per_clip": 4,
    "noise_sigma": 0, "hot_pixel_share": 0, "pause_probability": 0, "world_still_share": 0, "world_turn_only_share": 0,
    "crop_height_px": 256, "crop_width_px": 256,
}  # fmt: skip
arrays = ("voxels", "frames", "frames_blurred")
samples = V2VDataset(sys.argv[1], videos_kind="photographs", recipe=moving, arrays=arrays)
rows = []
for index in (0, 2):
    sample = samples[index]
    grey = (draw_grey(np.asarray(sample[name])[1, 0]) for name in arrays[1:])
    events = draw_events(np.asarray(sample["voxels"])[1, -2:].sum(axis=0), 3.0)
    rows.append(np.concatenate([*grey, events], axis=1))
write_png(Path(__file__).with_name("blurred.png"), np.concatenate(rows))
