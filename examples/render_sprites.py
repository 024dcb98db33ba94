"""Render labelled clips for `examples/detect.py`: discs and squares that fly over real footage.

    python examples/render_sprites.py --footage .demo/videos --out /tmp/sprites

Beside each clip lies a COCO-VID file of its boxes. The last videos of the footage give only clips to judge on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import av
import cv2
import numpy as np
import numpy.typing as npt

HEIGHT_PX, WIDTH_PX, FRAMES = 128, 160, 61
Pixels: TypeAlias = npt.NDArray[np.uint8]


def first_frames(video: Path) -> list[Pixels]:
    """Return the first frames, resized; fewer than FRAMES if the file is short or damaged."""
    frames = []
    with suppress(av.FFmpegError, IndexError), av.open(str(video)) as container:
        for frame in islice(container.decode(video=0), FRAMES):
            grey = cv2.resize(frame.to_ndarray(format="gray"), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
            frames.append(np.asarray(grey, np.uint8))
    return frames


def render(footage: Sequence[Pixels], path: Path, generator: np.random.Generator) -> None:
    """Write a clip of these frames with up to three sprites, and their boxes beside it."""
    sprites: list[list[Any]] = []
    for track in range(int(generator.integers(1, 4))):
        side, kind = int(generator.integers(18, 45)), int(generator.integers(2))
        texture = cv2.resize(generator.uniform(0, 255, (4, 4)).astype(np.float32), (side, side))
        y, x = np.mgrid[:side, :side] - (side - 1) / 2
        shape = np.hypot(x, y) <= side / 2 if kind == 0 else np.ones((side, side), bool)
        place = generator.uniform(0, (WIDTH_PX - side, HEIGHT_PX - side))
        sprites.append([track, kind, side, texture, shape, place, generator.uniform(-2.5, 2.5, 2)])
    images, annotations = [], []
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"crf": "15"})
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        for number, picture in enumerate(frame.copy() for frame in footage):
            images.append({"id": number, "frame_id": number})
            for sprite in sprites:
                track, kind, side, texture, shape, place, speed = sprite
                x, y = np.rint(place).astype(int)
                picture[y : y + side, x : x + side][shape] = texture[shape]
                box = [int(x), int(y), side, side]
                annotations.append({"image_id": number, "bbox": box, "category_id": kind, "instance_id": track})
                most = np.array([WIDTH_PX - side, HEIGHT_PX - side])
                speed[(place + speed < 0) | (place + speed > most)] *= -1  # bounce
                sprite[5] = np.clip(place + speed, 0, most)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")))
        out.mux(stream.encode())
    labels = {"videos": [{"id": 0}], "images": images, "annotations": annotations}
    path.with_suffix(".boxes.json").write_text(json.dumps(labels))


def main(argv: Sequence[str] | None = None) -> int:
    """Write the folders ``train`` and ``held-out``."""
    parser = argparse.ArgumentParser(description="Render sprites over footage, with their boxes.")
    parser.add_argument("--footage", required=True, type=Path, help="folder of videos, at least two")
    parser.add_argument("--out", required=True, type=Path, help="folder to write to")
    parser.add_argument("--clips", type=int, default=160, help="number of clips to train on")
    options = parser.parse_args(argv)
    files = sorted(path for path in options.footage.iterdir() if path.suffix in (".mp4", ".mkv", ".avi", ".webm"))
    usable = (frames for path in files if len(frames := first_frames(path)) == FRAMES)
    footage = list(islice(usable, 2 * options.clips))  # each of them in memory, 1.2 MB
    if len(footage) < 2:
        raise SystemExit(f"{options.footage}: {len(footage)} of {len(files)} videos have {FRAMES} frames: give two")
    generator, apart = np.random.default_rng(0), -(-len(footage) // 5)
    for name, videos, clips in (
        ("train", footage[:-apart], options.clips),
        ("held-out", footage[-apart:], -(-options.clips // 5)),
    ):
        (options.out / name).mkdir(parents=True, exist_ok=True)
        for number in range(clips):
            render(videos[number % len(videos)], options.out / name / f"{number:04}.mp4", generator)
    print(f"{options.out}: {options.clips} clips to train on")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
