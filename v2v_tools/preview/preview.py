"""`v2v-preview`: what a recipe makes of a video, to look at, without a server.

The whole picture without noise comes first. Then one clip for each virtual camera, made by the functions that a
server's worker uses, so what is shown is what a trainer gets. A video too short or too small for the recipe is shown
with shorter clips or smaller crops, and the output says so.
"""

from __future__ import annotations

import dataclasses
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
from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.progress import Progress
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_protocol.write_aside import check_output, write_file
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import defects_of_video
from v2v_server.motion.prediction import Prediction
from v2v_server.schedule.sequences import SequenceTable, VideoSequence
from v2v_server.simulation.intensity import tone_table
from v2v_server.store.pixels import VIDEOS, VideosKind, signal_of
from v2v_server.video.collect import ClipRequest, Cut
from v2v_server.video.luma import SDR
from v2v_server.video.probe import DOLBY_VISION
from v2v_tools.motion import (
    WholePictures,
    describe_loss,
    describe_start,
    moving_seeds,
    predicted_loss,
    quiet_voxels,
    start_events,
)
from v2v_tools.remake import Remaker, open_shown

LABELS = ("boxes", "masks")
"""Arrays that are drawn if the videos have their sidecars."""
PICTURE_SUFFIXES = (".png", ".mp4", ".gif", ".html")
_SMALLEST_CROP_PX = 16
_GIF_EVERY = 2  # every other bin: half the size


@dataclass(frozen=True, slots=True)
class Shot:
    """One camera of a preview.

    Attributes:
        title: written beside the camera; "" writes the seed.
        recipe: fields or a preset's name.
        seed: of the sample.
    """

    title: str
    recipe: Any
    seed: int


def preview(
    source: str,
    out: Path,
    shots: Sequence[Shot],
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
        shots: the cameras.
        spec: other fields of the StreamSpec; None in any takes the default.
        title: of the page.
        find_motion: take other seeds than those of ``shots``, whose crops show motion. Equal seeds stay equal.
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
    scene = StreamSpec.from_dict({**spec, "recipe": shots[0].recipe}).scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir, kind=kind)
    cameras: list[Camera] = []
    loss, started, notes = Prediction(), np.zeros(2), dict[str, list[str]]()
    try:
        first = _fitted_stream(catalogue, spec, shots[0].recipe)
        wholes = WholePictures(catalogue, first)
        if find_motion and not kind.is_rendered:
            shots, note = _moving(shots, Remaker(catalogue, first), wholes)
            say(note)
        with Progress("simulating", "cameras") as progress:
            for shot in shots:
                camera, lost, events = _camera(catalogue, shot, spec, with_flow, notes)
                cameras.append(camera)
                loss += lost
                started = started + events
                progress(len(cameras), len(shots))  # the first may include compiling; the estimate begins after it
        # A photograph stands still, apart from what each camera sees of it.
        whole = None if kind.is_rendered else wholes.camera(_sequence_of(catalogue, cameras[0].provenance))
        looks = first.scene == "off" and not kind.is_rendered
        shown = sorted({camera.provenance.video for camera in cameras}) if looks else ()
        defects = [each for id in shown for each in defects_of_video(catalogue, id)]
    finally:
        catalogue.close()
    _check_sizes(cameras, out.suffix.lower())
    for note, titles in notes.items():
        say(f"{', '.join(titles) if len(titles) < len(shots) else 'all cameras'}: {note}")
    say(f"{describe_start(started)} (recipe field start)")
    if not kind.is_rendered:
        say(describe_loss(loss, defects))
    write_file(out, _content(out.suffix.lower(), whole, cameras, title, moments))
    say(f"{out}: {len(cameras)} camera{'s' if len(cameras) > 1 else ''}")


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


def _moving(shots: Sequence[Shot], remaker: Remaker, wholes: WholePictures) -> tuple[list[Shot], str]:
    """Return the same cameras with seeds that show motion, and a note for the user."""
    asked = sorted({shot.seed for shot in shots})
    chosen, moving = moving_seeds(remaker, wholes, len(asked))
    seeds = dict(zip(asked, chosen, strict=True))
    names = f"seed{'s' if len(chosen) > 1 else ''} {', '.join(map(str, chosen))}"
    if moving == len(chosen):
        note = f"{names}: chosen because their crops show motion; --seed 0 takes what chance gives"
    else:
        note = f"{names}: {moving} of {len(chosen)} crops show more motion than noise, no more were found"
    return [dataclasses.replace(shot, seed=seeds[shot.seed]) for shot in shots], note


def _sequence_of(catalogue: Catalogue, provenance: Provenance) -> VideoSequence:
    (video,) = (video for video in catalogue.videos if video.id == provenance.video)
    return VideoSequence(video, provenance.start_frame)


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
    catalogue: Catalogue, shot: Shot, spec: Mapping[str, Any], with_flow: bool, notes: dict[str, list[str]]
) -> tuple[Camera, Prediction, npt.NDArray[np.float64]]:
    """Make one camera's clip; predict what it loses between frames, and count what its start makes.

    Adds the titles of the cameras that a note is about to ``notes``, by its text.
    """
    title = shot.title or f"seed {shot.seed}"
    asked, stream = StreamSpec.from_dict({**spec, "recipe": shot.recipe}), _fitted_stream(catalogue, spec, shot.recipe)
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
    if catalogue.kind == "photographs":
        labels = ["masks", "tracks"]
    arrays = ("voxels", "frames", *(("flow",) if with_flow else ()), *labels)
    made = Remaker(catalogue, stream, arrays).made(shot.seed, 0, 0)
    provenance = made.sample.provenance
    remark = f"{provenance.video} {provenance.remark}" if provenance.remark else ""
    for note in filter(None, (remark, _signal_note(catalogue, provenance, stream.recipe))):
        notes.setdefault(note, []).append(title)
    whole = _whole_picture(catalogue, provenance, stream.recipe)
    camera = Camera.of(made.sample.arrays, provenance, title, stream.recipe, whole)
    quiet_grids = quiet_voxels(made).reshape(-1, *camera.voxels.shape[1:])
    quiet = dataclasses.replace(camera, voxels=quiet_grids[camera.lead_voxels :])
    rate = _sequence_of(catalogue, provenance).video.frames_per_second
    timed = dataclasses.replace(camera, quiet=quiet.rates, step_seconds=stream.recipe.frame_stride / rate)
    return timed, predicted_loss(made), start_events(made)


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
    """Return the stream of a recipe that :func:`_fitted` has made fit."""
    stream = StreamSpec.from_dict({**spec, "recipe": recipe})
    return StreamSpec.from_dict({**spec, "recipe": _fitted(catalogue, stream)})


def _fitted(catalogue: Catalogue, stream: StreamSpec) -> Recipe:
    """Return the recipe, with shorter clips or smaller crops if the videos admit no others."""
    recipe = stream.recipe
    while True:
        table = SequenceTable(catalogue.videos, catalogue.rows, stream)
        if table.count:
            return recipe
        longest = max(table.longest_clips, default=0)
        if longest:
            recipe = recipe.replace(voxels_per_clip=longest)
        elif min(recipe.crop_height_px, recipe.crop_width_px) * 3 // 4 >= _SMALLEST_CROP_PX:
            smaller = (side * 3 // 4 for side in (recipe.crop_height_px, recipe.crop_width_px))
            recipe = recipe.replace(**dict(zip(("crop_height_px", "crop_width_px"), smaller, strict=True)))
        else:
            raise CorpusError(f"no video can be shown: {table.refusals[0]}")
        stream = StreamSpec.from_dict({**stream.to_dict(), "recipe": recipe})
