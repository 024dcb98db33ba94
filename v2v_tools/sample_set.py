"""`v2v-simulate --count N`: write samples of a stream as recordings, a training set on disk."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import SampleUnavailable, UsageError, V2VError
from v2v_protocol.programs import counted, show
from v2v_protocol.progress import Progress
from v2v_protocol.spec_flags import add_spec
from v2v_protocol.write_aside import write_file
from v2v_recordings.writers import EVENT_FORMS, check_form, open_writer
from v2v_server.worker.making.make import list_sample_events, span_ends_us
from v2v_tools.remake import RemadeSample
from v2v_tools.sample_flags import add_folder, add_samples, asked_remaker, asked_spec, make_folder

_PLANES = {"frames": "images", "flow": "flow", "masks": "masks"}
"""What a recording calls the arrays that it can hold."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-simulate", "VIDEO|DIR|LIST --count N --out DIR [flags]",
        "Write N samples of a stream as recordings of events, with pictures, flow and masks: a training set on disk.",
        [
            "v2v-simulate webvid10k/ --count 1000 --out set/ --events h5",
            "v2v-simulate webvid10k/ --count 100 --out set/ --events h5 --arrays frames,flow --seed 3 --epoch 2",
        ],
    )  # fmt: skip
    add_samples(parser)
    out = add_folder(parser, "SEED-EPOCH-INDEX and its .json", "h5")
    out.add_argument(
        "--count", type=int, required=True, metavar="N",
        help="number of samples, from --index on; the next epochs follow",
    )  # fmt: skip
    out.add_argument(
        "--arrays", metavar="NAME,NAME",
        help=f"of {', '.join(_PLANES)} (default frames if the form holds pictures, else none)",
    )  # fmt: skip
    add_spec(parser)
    return run_command(
        parser, _run, argv, failures=(V2VError,), interrupted="interrupted; the recordings written so far are complete"
    )


def _run(asked: argparse.Namespace) -> int | None:
    """Write the recordings; return FAILED if a sample could not be made."""
    spec, form = asked_spec(asked), EVENT_FORMS[asked.events]
    default = "frames" if form.planes else ""
    arrays = tuple(filter(None, (default if asked.arrays is None else asked.arrays).split(",")))
    if unknown := [name for name in arrays if name not in _PLANES]:
        raise UsageError(f"--arrays {','.join(unknown)}: a recording holds {', '.join(_PLANES)}; give some of these")
    check_form(asked.out / "sample", asked.events, spec.recipe.crop_px[::-1], [_PLANES[name] for name in arrays])
    if asked.count < 1:
        raise UsageError(f"--count {asked.count}: give a whole number from 1")
    remaker = asked_remaker(asked, spec, arrays or ("frames",))
    if not 0 <= asked.index < remaker.count:
        raise UsageError(f"--index {asked.index}: the epoch has {counted(remaker.count, 'sample')}, from 0 on")
    make_folder(asked.out)
    failed = events = 0
    with Progress("writing samples", "samples") as progress:
        for done in range(asked.count):
            progress(done, asked.count)
            later, index = divmod(asked.index + done, remaker.count)
            epoch = asked.epoch + later
            path = asked.out / f"{asked.seed}-{epoch}-{index}{form.ending}"
            try:
                remade = remaker.made(asked.seed, epoch, index)
            except SampleUnavailable as error:
                progress.notice(f"{path} is left out: {error}")
                failed += 1
                continue
            for name, why in remade.sample.provenance.unlabelled.items():
                progress.notice(f"{path} has no {name}: {why}")
            events += _write(path, asked.events, remade, arrays)
            write_file(path.with_suffix(".json"), json.dumps(remade.sample.provenance.to_dict()) + "\n")
    show(f"{counted(asked.count - failed, 'recording')} with {counted(events, 'event')} written to {asked.out}")
    return FAILED if failed else None


def _write(path: Path, form: str, remade: RemadeSample, arrays: tuple[str, ...]) -> int:
    """Write one sample; return its number of events."""
    sample, clip = remade.sample, remade.job.clip
    recipe, ends_us = clip.spec.recipe, span_ends_us(clip, remade.decoded).tolist()
    events = list_sample_events(clip, remade.decoded)
    planes = [_PLANES[name] for name in arrays if name not in sample.provenance.unlabelled]
    with open_writer(path, form, (events.width_px, events.height_px), planes) as writer:
        writer.add(events)
        if "flow" in planes:
            flow = np.asarray(sample.arrays["flow"], np.float32)
            # A field holds until the next one, so the last one needs an end.
            for at_us, field in zip(ends_us[recipe.lead_voxels :], [*flow, np.full_like(flow[0], np.nan)], strict=True):
                writer.add_plane("flow", at_us, field)
        for name in ("frames", "masks"):
            if _PLANES[name] in planes:
                for at_us, plane in zip(ends_us[recipe.first_frame :], sample.arrays[name][:, 0], strict=True):
                    writer.add_plane(_PLANES[name], at_us, plane)
    return len(events)
