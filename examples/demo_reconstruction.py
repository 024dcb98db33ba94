"""Reconstruct a clip with the shipped network, which was not trained on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from trainer.pictures import EVENTS, Video, add_header, contact_sheet, draw_events, draw_grey, side_by_side, write_png
from trainer.weights import SHIPPED, load_network
from v2v_client import V2VDataset

_RECIPE = {
    "preset": "noise-free",
    "threshold": 0.2,
    "voxels_per_clip": 30,
    "crop_height_px": 192,
    "crop_width_px": 256,
    "pause_probability": 0.0,
    "flip_probability": 0.0,
}
_ROWS = 4
_PANELS = (EVENTS, "camera", "reconstruction")
_FILM_HZ = 10.0


def reconstruct(clip: Path, picture: Path) -> None:
    """Draw events, camera and reconstruction side by side.

    Args:
        clip: video from which a virtual camera makes the events.
        picture: PNG of a few moments; the film of all moments is written next to it, as MP4.
    """
    network, _ = load_network(SHIPPED)
    sample = V2VDataset(clip, recipe=_RECIPE)[0].arrays
    with torch.inference_mode():
        seen = network.forward_sequence(torch.from_numpy(sample["voxels"])[None].float())[0, :, 0].clamp(0, 1).numpy()
    target = sample["frames"][:, 0].astype(np.float32) / 255.0
    film = side_by_side([draw_events(sample["voxels"]), draw_grey(target), draw_grey(seen)])
    title = "Reconstructed from events by the shipped network"
    write_png(picture, add_header(contact_sheet(film, _ROWS), _PANELS, title, time_runs_down=True))
    with Video(picture.with_suffix(".mp4"), _FILM_HZ) as video:
        for image in film:
            video.add(add_header(image, _PANELS))
    print(f"picture: {picture} (events, camera, reconstruction by the shipped network; time runs down)")
