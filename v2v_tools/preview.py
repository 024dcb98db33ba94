"""`v2v-preview`: what a recipe makes of a video, to look at, without a server.

The whole picture without noise comes first. Then one clip for each virtual camera, made by the functions that a
server's worker uses, so what is shown is what a trainer gets. A video too short or too small for the recipe is shown
with shorter clips or smaller crops, and the output says so.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_pictures.camera import Camera
from v2v_pictures.files import gif_bytes, html_page, mp4_bytes, png_bytes
from v2v_pictures.film import FRAMES_PER_SECOND, draw_film
from v2v_pictures.sheet import draw_sheet
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import CorpusError, UsageError, V2VError
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import add_spec, asked_recipe, recipe_setting, spec_fields
from v2v_protocol.write_aside import check_output, write_file
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import defects_of_video
from v2v_server.corpus_words import notes_of
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, KindFlags, kind_from
from v2v_server.motion.measure import MeasuredMotion, together
from v2v_server.schedule import SequenceTable
from v2v_server.simulation.intensity import tone_table
from v2v_server.store.pixels import signal_of
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.picture import SDR
from v2v_server.video.probe import DOLBY_VISION
from v2v_server.worker.job import SampleJob
from v2v_tools.motion import (
    WholePictures,
    describe_motion,
    describe_start,
    measured_motion,
    moving_seeds,
    quiet_voxels,
    start_events,
    step_seconds,
)
from v2v_tools.remake import RemadeSample, Remaker, open_shown

LABELS = ("boxes", "masks")
"""Arrays that are drawn if the videos have their sidecars."""
PICTURE_SUFFIXES = (".png", ".mp4", ".gif", ".html")
_SMALLEST_CROP_PX = 16
_GIF_EVERY = 2  # every other bin: half the size
_MOST_CAMERAS = 32


@dataclass(frozen=True, slots=True)
class PreviewCamera:
    """One camera of a preview.

    Attributes:
        title: written beside the camera; "" writes the seed.
        recipe: its name, or fields.
        seed: of the sample.
    """

    title: str
    recipe: Any
    seed: int


def preview(
    source: str,
    out: Path,
    wanted: Sequence[PreviewCamera],
    spec: Mapping[str, Any],
    *,
    title: str,
    find_motion: bool = False,
    list_file: str | None = None,
    rows: str = "full",
    with_flow: bool = True,
    moments: int = 1,
    cache_dir: str | None = None,
    kind: VideosKind = VIDEOS,
    say: Callable[[str], None] = print,
) -> None:
    """Make the cameras' clips, draw them, and write the file.

    Args:
        source, list_file, rows: the corpus, as for a server.
        out: .png (a sheet), .mp4 or .gif (a film), or .html (both in one file).
        wanted: the cameras.
        spec: other fields of the StreamSpec; None in any takes the default.
        title: of the page.
        find_motion: take other seeds than those of ``wanted``, whose crops show motion. Equal seeds stay equal.
        with_flow: show optical flow too.
        moments: voxel grids to show of each camera on a sheet.
        cache_dir: folder of the catalogue index; None: the user's cache.
        kind: what a video is.
        say: called with each line for the user.

    Raises:
        UsageError: unknown ending, wrong recipe, or a file that cannot be written.
        CorpusError: no video can be used, even with short clips and small crops.
        SampleUnavailable, VideoUnreadable: see :func:`v2v_tools.remake.remake`.
    """
    check_output("--out", out, PICTURE_SUFFIXES, [source])  # before any work
    scene = StreamSpec.from_dict({**spec, "recipe": wanted[0].recipe}).scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir, kind=kind)
    cameras: list[Camera] = []
    jobs, moving, started, notes = list[SampleJob](), list[MeasuredMotion](), np.zeros(2), dict[str, list[str]]()
    for note in notes_of(catalogue):
        say(note)
    try:
        first = _fitted_stream(catalogue, spec, wanted[0].recipe)
        wholes = WholePictures(catalogue)
        if find_motion and kind.has_motion:
            wanted, note = _moving(wanted, Remaker(catalogue, first), wholes)
            say(note)
        with Progress("simulating", "cameras") as progress:
            for each in wanted:
                camera, made = _camera(catalogue, each, spec, with_flow, notes)
                cameras.append(camera)
                jobs.append(made.job)
                moving.append(measured_motion(made))
                started = started + start_events(made)
                progress(len(cameras), len(wanted))  # the first may include compiling; the estimate begins after it
        whole = wholes.camera(jobs[0]) if kind.has_motion else None
        looks = first.scene == "off" and kind.has_scenes
        shown = sorted({camera.provenance.video for camera in cameras}) if looks else ()
        defects = [each for id in shown for each in defects_of_video(catalogue, id)]
    finally:
        catalogue.close()
    _check_sizes(cameras, out.suffix.lower())
    for note, titles in notes.items():
        say(f"{', '.join(titles) if len(titles) < len(wanted) else 'all cameras'}: {note}")
    if kind.is_simulated:
        say(f"{describe_start(started)} (recipe field start)")
    if kind.has_motion:
        say(f"motion: {'; '.join(filter(None, describe_motion(together(moving), defects)))}")
    write_file(out, _content(out.suffix.lower(), whole, cameras, title, moments))
    say(f"{out}: {counted(len(cameras), 'camera')}")


def _check_sizes(cameras: Sequence[Camera], kind: str) -> None:
    """Check that the cameras can be drawn side by side: a sheet has a column per bin, a film the moments of all.

    Raises:
        UsageError: they have other sizes.
    """
    wanted = 1 if kind == ".png" else 2
    sizes = {camera.voxels.shape[1::-1][:wanted]: camera for camera in cameras}
    if len(sizes) > 1:
        found = ", ".join(
            f"{each.title} has {each.voxels.shape[0]} frames of {each.voxels.shape[1]} bins here"
            for each in sizes.values()
        )
        raise UsageError(
            f"{found}: give recipes of equal bins and grids_per_frame, and for a film of equal voxels_per_clip (--set "
            "changes all of them)"
        )


def _moving(
    wanted: Sequence[PreviewCamera], remaker: Remaker, wholes: WholePictures
) -> tuple[list[PreviewCamera], str]:
    """Return the same cameras with seeds that show motion, and a note for the user."""
    asked = sorted({each.seed for each in wanted})
    chosen, moving = moving_seeds(remaker, wholes, len(asked))
    seeds = dict(zip(asked, chosen, strict=True))
    names = f"seed{'s' if len(chosen) > 1 else ''} {', '.join(map(str, chosen))}"
    if moving == len(chosen):
        note = f"{names}: chosen because their crops show motion; --seed 0 takes what chance gives"
    else:
        note = f"{names}: {moving} of {len(chosen)} crops show more motion than noise, no more were found"
    return [dataclasses.replace(each, seed=seeds[each.seed]) for each in wanted], note


def _content(kind: str, whole: Camera | None, cameras: Sequence[Camera], title: str, moments: int) -> bytes | str:
    if kind == ".png":
        return png_bytes(draw_sheet(cameras, title, moments=moments, whole=whole))
    grids, bins = cameras[0].voxels.shape[:2]
    film = []
    with Progress("drawing the film", "pictures") as progress:
        for picture in draw_film(cameras, title, whole=whole):
            film.append(picture)
            progress(len(film), grids * bins)
    if kind == ".mp4":
        return mp4_bytes(film, FRAMES_PER_SECOND)
    if kind == ".gif":
        return gif_bytes(film[::_GIF_EVERY], FRAMES_PER_SECOND / _GIF_EVERY)
    return html_page(title, draw_sheet(cameras, title, moments=moments, whole=whole), film, FRAMES_PER_SECOND)


def _camera(
    catalogue: Catalogue, wanted: PreviewCamera, spec: Mapping[str, Any], with_flow: bool, notes: dict[str, list[str]]
) -> tuple[Camera, RemadeSample]:
    """Make one camera's clip. Adds the titles of the cameras that a note is about to ``notes``, by its text."""
    title = wanted.title or f"seed {wanted.seed}"
    asked = StreamSpec.from_dict({**spec, "recipe": wanted.recipe})
    stream = _fitted_stream(catalogue, spec, wanted.recipe)
    if stream != asked:
        fitted, recipe = stream.recipe, asked.recipe
        note = (
            f"shown with {fitted.voxels_per_clip} voxel grids of {fitted.crop_width_px} x "
            f"{fitted.crop_height_px} instead of {recipe.voxels_per_clip} of {recipe.crop_width_px} x "
            f"{recipe.crop_height_px}: no video here is long and large enough for more"
        )
        notes.setdefault(note, []).append(title)
    sidecars = catalogue.sidecars
    labels = [name for name in LABELS if any(sidecars[each].fingerprints for each in sidecar_endings((name,)))]
    arrays = (
        "voxels",
        "frames",
        *(["frames_blurred"] if any(stream.recipe.exposure_seconds) else ()),
        *(("flow",) if with_flow else ()),
        *(catalogue.kind.shown_arrays or labels),
    )
    made = Remaker(catalogue, stream, arrays).made(wanted.seed, 0, 0)
    provenance = made.sample.provenance
    if note := _signal_note(catalogue, provenance, stream.recipe):
        notes.setdefault(note, []).append(title)
    whole = _whole_picture(catalogue, provenance, stream.recipe)
    camera = Camera.of(made.sample.arrays, provenance, title, stream.recipe, whole)
    quiet_grids = quiet_voxels(made).reshape(-1, *camera.voxels.shape[1:])
    quiet = dataclasses.replace(camera, voxels=quiet_grids[camera.lead_voxels :])
    return dataclasses.replace(camera, quiet=quiet.rates, step_seconds=step_seconds(made.job.clip)), made


def _signal_note(catalogue: Catalogue, provenance: Provenance, recipe: Recipe) -> str:
    """Return what the video states about its levels, and whether the recipe uses it; "" for 8 bits of SDR."""
    id = provenance.video
    with catalogue.source.open_pixels(id, provenance.fingerprint) as pixels:
        signal = signal_of(pixels, catalogue.frame_index(id))
    if DOLBY_VISION in provenance.remark:
        return ""  # the stated transfer does not hold for IPT-PQ
    if signal == SDR or recipe.light == "declared":
        return "" if signal == SDR else f"{id} has {signal}"
    return f"{id} has {signal}, and is read as {SDR}: --set light=declared uses what it has"


def _whole_picture(catalogue: Catalogue, provenance: Provenance, recipe: Recipe) -> npt.NDArray[np.uint8]:
    """Read the video's rows at the clip's first frame: [rows, columns] uint8, tone mapped as ``frames`` are."""
    index = catalogue.frame_index(provenance.video)
    top, bottom = catalogue.rows.bounds(index.height_px)
    cut = Cut(1, (top, 0, bottom - top, index.width_px))
    most_bits = None if recipe.light == "sdr" else SDR.bits
    with catalogue.source.open_pixels(provenance.video, provenance.fingerprint) as pixels:
        pixels.check(provenance.fingerprint)
        (clip,) = pixels.clips(ClipRequest(index, provenance.start_frame, (cut,), most_bits=most_bits))
    picture: npt.NDArray[np.uint8] = tone_table(recipe.gamma, clip.signal)[clip.frames[0]]
    return picture


def _fitted_stream(catalogue: Catalogue, spec: Mapping[str, Any], recipe: Any) -> StreamSpec:
    """Return the stream of a recipe, with shorter clips or smaller crops if the videos admit no others."""
    while True:
        stream = StreamSpec.from_dict({**spec, "recipe": recipe})
        table, recipe = SequenceTable(catalogue.videos, catalogue.rows, stream), stream.recipe
        if table.count:
            return stream
        longest, sides = max(table.longest_clips, default=0), (recipe.crop_height_px, recipe.crop_width_px)
        if longest:
            recipe = recipe.replace(voxels_per_clip=longest)
        elif min(sides) * 3 // 4 >= _SMALLEST_CROP_PX:
            recipe = recipe.replace(crop_height_px=sides[0] * 3 // 4, crop_width_px=sides[1] * 3 // 4)
        else:
            raise CorpusError(f"no video can be shown: {table.refusals[0]}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-preview", "VIDEO|DIR [VIDEO ...] --out FILE [flags]",
        "Show the effect of a recipe on your videos: frames, events, flow, activity.",
        [
            "v2v-preview clips/ --out sheet.png --recipe davis346-measured",
            "v2v-preview clip.mp4 --out compared.html --compare paper clean davis346-measured",
        ],
    )  # fmt: skip
    cameras = parser.group("Virtual cameras")
    cameras.add_argument("--seeds", type=int, metavar="N", help="virtual cameras to draw (default 4)")
    cameras.add_argument(
        "--seed", type=int, metavar="S",
        help="seed of the first camera; the others have the next seeds (default: seeds whose crops show motion)",
    )  # fmt: skip
    cameras.add_argument(
        "--compare", nargs="+", metavar="NAME", help="show the same clip under these recipes instead, one camera each"
    )
    videos = parser.group("Videos")
    videos.add_argument(
        "sources", nargs="+", metavar="VIDEO|DIR",
        help="a video, a folder of videos, or a list file; with several, each gets a FILE-NAME of its own",
    )  # fmt: skip
    parser.add_settings(ServeConfig, "list", "rows", "cache_dir")
    parser.add_settings(KindFlags)
    out = parser.group("Output")
    parser.add_output(
        "Output", "--out", PICTURE_SUFFIXES, f"picture, film or page: {', '.join(PICTURE_SUFFIXES)}", required=True
    )
    out.add_argument(
        "--moments", type=int, default=1, metavar="N", help="number of voxel grids of each camera (default 1)"
    )
    out.add_argument("--no-flow", action="store_true", help="leave optical flow out")
    add_spec(parser)
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="interrupted; nothing was written")


def _run(arguments: argparse.Namespace) -> None:
    count = 4 if arguments.seeds is None else arguments.seeds
    for flag, value in (("--seeds", count), ("--moments", arguments.moments)):
        if not 1 <= value <= _MOST_CAMERAS:
            raise UsageError(f"{flag} {value}: give 1 to {_MOST_CAMERAS}")
    first = arguments.seed or 0
    if arguments.compare:
        if arguments.recipe is not None:
            raise UsageError("--compare names the recipes: leave --recipe out")
        if arguments.seeds is not None:
            raise UsageError("--compare shows each recipe with one seed: leave --seeds out")
        wanted = [
            PreviewCamera(Path(name).stem, recipe_setting(name, arguments.set), first) for name in arguments.compare
        ]
        what = "the same clip under " + ", ".join(each.title for each in wanted)
    else:
        name = asked_recipe(arguments) or "paper"
        recipe = recipe_setting(name, arguments.set)
        wanted = [PreviewCamera("", recipe, seed) for seed in range(first, first + count)]
        what = f'virtual cameras drawn from the recipe "{Path(name).stem}"'
    for each in wanted:
        each.recipe.warn()
    kind = kind_from(vars(arguments))
    if arguments.seed is None and kind.has_motion:
        what += ", chosen where something moves"
    stem, names = arguments.out.stem, [Path(source).stem for source in arguments.sources]
    named = {
        arguments.out.with_stem(f"{stem}-{name}"): source for name, source in zip(names, arguments.sources, strict=True)
    }
    if len(named) < len(names):
        raise UsageError(f"two of the videos are named {max(names, key=names.count)}: preview them one at a time")
    for path, source in named.items():
        preview(
            source,
            path if len(named) > 1 else arguments.out,
            wanted,
            # Recipes are compared on one clip, so the order must not depend on how many sequences each admits.
            spec_fields(arguments) | ({"shuffle": False} if arguments.compare else {}),
            title=f"{Path(source).name}: {what}",
            find_motion=arguments.seed is None,
            list_file=arguments.list,
            rows=arguments.rows or "full",
            with_flow=not arguments.no_flow,
            moments=arguments.moments,
            cache_dir=arguments.cache_dir,
            kind=kind,
        )


if __name__ == "__main__":
    sys.exit(main())
