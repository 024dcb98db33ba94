"""`v2v-simulate`: make one sample of a stream, and write it as .npz, with its picture and its events."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from v2v_pictures.camera import Camera, check_drawable
from v2v_pictures.files import write_png
from v2v_pictures.sheet import draw_sheet
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_protocol.sample import ARRAYS, DEFAULT_ARRAYS, SampleParams
from v2v_protocol.spec_flags import add_spec
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.writers import ENDINGS, check_form, form_of, write_events
from v2v_server.worker.making.make import list_sample_events
from v2v_tools import sample_set, whole
from v2v_tools.sample_flags import add_samples, asked_remaker, asked_spec

_MOMENTS = 4
"""Voxel grids that a picture shows."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    given = {word.partition("=")[0] for word in (sys.argv[1:] if argv is None else argv)}
    if "--whole" in given:
        return whole.main(argv)
    if "--count" in given:
        return sample_set.main(argv)
    parser = Parser(
        "v2v-simulate", "VIDEO --out FILE.npz [flags]",
        "Make one sample in this process: the same bytes a server would stream.",
        [
            "v2v-simulate clip.mp4 --out sample.npz --picture sample.png --events events.h5",
            "v2v-simulate webvid10k/ --rows top:0.54 --seed 3 --epoch 2 --index 4711 --out sample.npz",
        ],
    )  # fmt: skip
    which = add_samples(parser)
    which.add_argument(
        "--whole", action="store_true", help="make events of whole videos instead: see v2v-simulate --whole --help"
    )
    which.add_argument(
        "--count", metavar="N", help="write N samples as recordings instead: see v2v-simulate --count --help"
    )
    out = parser.group("Output")
    parser.add_output(
        "Output", "--out", (".npz",), "output file for the arrays and the provenance (JSON)", required=True
    )
    parser.add_output("Output", "--picture", (".png",), "also write a picture of frames and voxels")
    parser.add_output(
        "Output",
        "--events",
        tuple(ENDINGS),
        f"also write the events with their times: {', '.join(ENDINGS)}",
    )
    out.add_argument(
        "--arrays", default=",".join(DEFAULT_ARRAYS), metavar="NAME,NAME",
        help=f"of {', '.join(ARRAYS)} (default {','.join(DEFAULT_ARRAYS)})",
    )  # fmt: skip
    add_spec(parser)
    return run_command(
        parser, _run, argv, failures=(V2VError,), interrupted="interrupted before all files were written"
    )


def _run(asked: argparse.Namespace) -> None:
    """Make one sample, and write it: the requested arrays and ``provenance``, a JSON text."""
    spec = asked_spec(asked)
    arrays = tuple(asked.arrays.split(","))
    if asked.picture is not None:
        check_drawable(arrays)
    if asked.events is not None:
        check_form(asked.events, form_of(asked.events), spec.recipe.crop_px[::-1])
    remaker = asked_remaker(asked, spec, arrays)
    remade = remaker.made(asked.seed, asked.epoch, asked.index)
    sample, provenance = remade.sample, remade.sample.provenance
    content: dict[str, Any] = {**sample.arrays, "provenance": json.dumps(provenance.to_dict())}
    try:
        with write_aside_and_rename(asked.out) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **content)
        if asked.picture is not None:
            camera = Camera.of(sample.arrays, provenance, f"index {asked.index}", spec.recipe)
            write_png(asked.picture, draw_sheet([camera], f"seed {asked.seed}, epoch {asked.epoch}", moments=_MOMENTS))
        if asked.events is not None:
            events = list_sample_events(remade.job.clip, remade.decoded)
            write_events(asked.events, events)
            show(f"{len(events)} events written to {asked.events}")
    except OSError as error:
        raise UsageError(f"{error.filename or asked.out}: {error.strerror}") from error
    for name, why in provenance.unlabelled.items():
        show(f"no {name}: {why}")
    params = provenance.params
    show(
        f"{provenance.video} from frame {provenance.start_frame}: "
        + ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in sample.arrays.items())
        + ("; recorded events, " if provenance.is_recorded else _drawn(params))
        + f"{provenance.saturated_bins} bins saturated; written to {asked.out}"
    )


def _drawn(params: SampleParams) -> str:
    thresholds = f"; thresholds +{params.threshold_pos:.3f} -{params.threshold_neg:.3f}"
    return f"{thresholds}, noise {params.noise_sigma:.3f}, {params.hot_pixel_count} hot pixels, "


if __name__ == "__main__":
    sys.exit(main())
