"""Make training clips from photographs: each is panned, turned and zoomed, with moving patches of others in front.

    python examples/pan_photographs.py PHOTOGRAPHS OUT --clips 120

A few dozen photographs give a network more scenes than a handful of films do. Motion is smooth and random, like that of
a hand-held camera. A patch is an ellipse of another photograph with its own motion, so that edges occlude each other.
PNG files with transparent parts are objects without background: they become patches of their own shape. Networks for
real windows, which are short, need many frames a second and large plain areas, most of them bright:

    python examples/pan_photographs.py PHOTOGRAPHS OUT --frames 601 --rate 240 --plain 0.3 --walls 0.5
"""

import argparse
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

WIDTH, HEIGHT = 320, 240


def smooth(random: np.random.Generator, step: float, count: int) -> np.ndarray:
    """Return a path (count,) float64 from 0, whose change per frame is about `step` and varies slowly."""
    knots = random.normal(0, step, 8)
    speed = np.interp(np.linspace(0, 7, count), np.arange(8), knots)
    return np.asarray(np.cumsum(speed) - speed[0])


def motion(random: np.random.Generator, speed: float, count: int) -> np.ndarray:
    """Return homographies (count, 3, 3) float64 in px: pan by about `speed` px per frame, turns, zoom, tilt."""
    x, y = smooth(random, speed, count), smooth(random, speed, count)
    angle, zoom = smooth(random, 0.004 * speed, count), np.exp(smooth(random, 0.002 * speed, count))
    tilt = smooth(random, 4e-6 * speed, count), smooth(random, 4e-6 * speed, count)
    centre = np.array([[1, 0, WIDTH / 2], [0, 1, HEIGHT / 2], [0, 0, 1]])
    steps = np.zeros((count, 3, 3))
    for t in range(count):
        c, s = zoom[t] * np.cos(angle[t]), zoom[t] * np.sin(angle[t])
        steps[t] = centre @ [[c, -s, x[t]], [s, c, y[t]], [tilt[0][t], tilt[1][t], 1]] @ np.linalg.inv(centre)
    return steps


def downscale(photograph: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Downscale a photograph (H, W, 3) uint8 randomly, to at least 1.5 times the size of the frame."""
    fill = 1.5 * max(WIDTH / photograph.shape[1], HEIGHT / photograph.shape[0])
    scale = min(fill * random.uniform(1, 2.5), 1.0)
    smaller = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(smaller[:, :: random.choice((-1, 1))])


def flat(picture: np.ndarray) -> np.ndarray:
    """Return the colours of a picture as one smooth gradient."""
    return cv2.resize(cv2.resize(picture, (2, 2), interpolation=cv2.INTER_AREA), picture.shape[1::-1])


def wall(picture: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a picture as a bright wall: mean level 170 to 250, at most 0.8 of the contrast, a weak gradient."""
    gradient = flat(picture).astype(np.float32)
    light = random.uniform(170, 250) + random.uniform(0, 0.4) * (gradient - gradient.mean())
    bright = light + random.uniform(0, 0.8) * (picture - gradient)
    return np.asarray(np.rint(bright.clip(0, 255)), np.uint8)


def ellipse(photographs: list[np.ndarray], random: np.random.Generator) -> np.ndarray:
    """Return a patch (HEIGHT, WIDTH, 4) uint8: an ellipse of a photograph at a random place, transparent elsewhere."""
    picture = downscale(photographs[random.integers(len(photographs))], random)
    if picture.shape[0] < HEIGHT or picture.shape[1] < WIDTH:
        picture = cv2.resize(picture, (WIDTH, HEIGHT))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    middle = random.integers((0, 0), (WIDTH, HEIGHT)).tolist()
    cv2.ellipse(mask, middle, random.integers(15, 90, 2).tolist(), random.uniform(0, 180), 0, 360, 255, -1)
    return np.dstack((picture[:HEIGHT, :WIDTH], mask))


def cut_out(objects: list[np.ndarray], random: np.random.Generator) -> np.ndarray:
    """Return a patch (HEIGHT, WIDTH, 4) uint8: an object 60 to 200 px high at a random place."""
    thing = objects[random.integers(len(objects))]
    scale = random.uniform(60, 200) / thing.shape[0]
    thing = cv2.resize(thing, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[:, :: random.choice((-1, 1))]
    place = np.eye(2, 3)
    place[:, 2] = random.uniform((0, 0), (WIDTH, HEIGHT)) - np.array(thing.shape[1::-1]) / 2
    return np.asarray(cv2.warpAffine(thing, place, (WIDTH, HEIGHT)))


def clip(
    photographs: list[np.ndarray],
    objects: list[np.ndarray],
    random: np.random.Generator,
    count: int,
    plain: float,
    walls: float = 0.0,
) -> np.ndarray:
    """Return frames (count, HEIGHT, WIDTH, 3) uint8 of a background and up to six patches."""
    frames = np.zeros((count, HEIGHT, WIDTH, 3), np.uint8)
    is_wall = walls > 0 and random.random() < walls
    is_plain = plain > 0 and random.random() < plain
    background = downscale(photographs[random.integers(len(photographs))], random)
    background = wall(background, random) if is_wall else flat(background) if is_plain else background
    start = np.eye(3)
    start[:2, 2] = -random.integers(0, np.maximum(np.array(background.shape[1::-1]) - (WIDTH, HEIGHT), 1))
    for t, step in enumerate(motion(random, pace(random), count)):
        frames[t] = cv2.warpPerspective(background, step @ start, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT_101)
    for _ in range(random.integers(*((1, 5) if is_wall else (3, 7) if is_plain else (0, 4)))):
        patch = cut_out(objects, random) if objects and random.random() < 0.5 else ellipse(photographs, random)
        if plain > 0 and random.random() < plain:
            patch[..., :3] = flat(patch[..., :3])
        for t, step in enumerate(motion(random, pace(random), count)):
            moved = cv2.warpPerspective(patch, step, (WIDTH, HEIGHT))
            x, y, width, height = cv2.boundingRect(moved[..., 3])
            moved, under = moved[y : y + height, x : x + width], frames[t, y : y + height, x : x + width]
            inside = moved[..., 3:] / np.float32(255)
            under[:] = np.rint(inside * moved[..., :3] + (1 - inside) * under)
    return frames if is_wall else tone(random)[frames]


def pace(random: np.random.Generator) -> float:
    """Return a speed in px per frame, from 0.2 to 3, uniform in its logarithm."""
    return float(np.exp(random.uniform(np.log(0.2), np.log(3))))


def tone(random: np.random.Generator) -> np.ndarray:
    """Return a lookup table (256,) uint8 of exposure: gamma 0.6 to 1.6, with reduced contrast."""
    low, high = random.uniform(0, 40), random.uniform(180, 255)
    return np.rint(low + (high - low) * (np.arange(256) / 255) ** random.uniform(0.6, 1.6)).astype(np.uint8)


def write(path: Path, frames: np.ndarray, rate: int) -> None:
    """Encode frames (T, H, W, 3) uint8, BGR, as nearly lossless H.264."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=Fraction(rate), options={"crf": "10", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "bgr24")))
        file.mux(stream.encode())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path, help="folder of JPEG or PNG files")
    parser.add_argument("out", type=Path)
    parser.add_argument("--clips", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=130, help="frames of a clip")
    parser.add_argument("--rate", type=int, default=30, help="frames a second; motion is given per frame")
    parser.add_argument(
        "--plain", type=float, default=0.0, help="share of backgrounds, and of patches, that are a smooth gradient"
    )
    parser.add_argument(
        "--walls",
        type=float,
        default=0.0,
        help="share of backgrounds that are bright walls",
    )
    args = parser.parse_args()
    files = sorted(p for p in args.photographs.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    pictures = [picture for p in files if (picture := cv2.imread(str(p), cv2.IMREAD_UNCHANGED)) is not None]
    pictures = [cv2.cvtColor(p, cv2.COLOR_GRAY2BGR) if p.ndim == 2 else p for p in pictures if p.dtype == np.uint8]
    objects = [p for p in pictures if p.shape[2] == 4 and p[..., 3].min() < 255]
    photographs = [p[..., :3] for p in pictures if p.shape[2] == 3 or p[..., 3].min() == 255]
    if not photographs:
        raise SystemExit(f"no photograph in {args.photographs} ({len(files)} image files): give JPEG or opaque PNG")
    args.out.mkdir(parents=True, exist_ok=True)
    for index in range(args.clips):
        random = np.random.default_rng((args.seed, index))
        frames = clip(photographs, objects, random, args.frames, args.plain, args.walls)
        write(args.out / f"pan_{index:04d}.mp4", frames, args.rate)
        print(f"\r{index + 1}/{args.clips}", end="", flush=True)
    print()


if __name__ == "__main__":
    main()
