"""Run `v2v-convert`.

Exit status: 0 everything was converted, 1 a file could not be written, 2 wrong usage or input (recordings converted
before stay), 130 interrupted, by SIGTERM too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainer.convert.conversion import Converted, convert, default_name
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.progress import Progress
from v2v_protocol.write_aside import JSON, write_json
from v2v_recordings import items, layout
from v2v_recordings.reading import FORMS


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        "v2v-convert", "SRC [SRC ...] --out PATH [flags]",
        "Convert recordings of event cameras into the h5 layout that v2v-eval reads.",
        ["v2v-convert boxes_6dof/ --out recordings/", "v2v-convert a.bag --events-topic /dvs/events --out a.h5"],
        "Forms:\n" + "\n".join(f"  {name:14s} {form.title}" for name, form in FORMS.items()),
    )  # fmt: skip
    recordings, out = parser.group("Recordings"), parser.group("Output")
    recordings.add_argument("sources", nargs="+", metavar="SRC", help="recording: a file or a folder; never written to")
    out.add_argument(
        "--out", required=True, metavar="PATH", help="folder for the new files, or (one SRC) a file ending in .h5"
    )
    recordings.add_argument("--form", choices=tuple(FORMS), help="form of the recordings (default: detected)")
    items.add_options(recordings)
    out.add_argument("--overwrite", action="store_true", help="replace files that exist")
    parser.add_output("Output", "--json", JSON, "also write a record of each recording to this file")
    interrupted = "interrupted; no incomplete file is left"
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted=interrupted)


def _run(arguments: argparse.Namespace) -> int:
    options = items.options_of(arguments)
    out = Path(arguments.out)
    to_file = out.suffix.lower() in layout.SUFFIXES
    if to_file and len(arguments.sources) > 1:
        raise UsageError(f"--out {out} is one file, and there are {len(arguments.sources)} recordings: give a folder")
    sources = [Path(source) for source in arguments.sources]
    destinations = [out if to_file else out / default_name(source) for source in sources]
    for number, destination in enumerate(destinations):
        if (first := destinations.index(destination)) < number:
            raise UsageError(
                f"{sources[first]} and {sources[number]} would both become {destination}: convert one at a time, each "
                "with its own --out"
            )
    records = []
    for source, destination in zip(sources, destinations, strict=True):
        with Progress(source.name, "%") as progress:
            done = convert(
                source,
                destination,
                form=arguments.form,
                options=options,
                overwrite=arguments.overwrite,
                progress=progress,
            )
        print(summary(done))
        records.append(_record(done))
    if arguments.json is not None:
        write_json(arguments.json, records)
    return 0


def summary(done: Converted) -> str:
    """Return a summary of one conversion, in a few lines."""
    written = done.written
    text = (
        f"{done.destination}: {written.events} events in {written.seconds:.3f} s, {written.images} images, "
        f"{written.size.width} x {written.size.height} ({done.form})"
    )
    text += "".join(f"\n  {note}" for note in written.notes)
    if written.size_is_guessed:
        text += "\n  the recording does not state the sensor's size; the events' area is used: give --size WxH"
    if written.reordered_events:
        text += f"\n  {written.reordered_events} events were earlier than their predecessor; sorted"
    if written.backward_images:
        text += (
            f"\n  {written.backward_images} images are not later than the previous one; v2v-eval repairs their times"
        )
    if written.images and written.light:
        text += f"\n  light of the images: {written.light}"
    elif written.images:
        text += "\n  light of the images: not known; v2v-fit and v2v-eval need it: give --light if you know it"
    if not written.images:
        text += "\n  no images: v2v-eval can reconstruct it (--fps), but not score it"
    return text


def _record(done: Converted) -> dict[str, str | int | float]:
    written = done.written
    return {
        "source": str(done.source),
        "destination": str(done.destination),
        "form": done.form,
        "events": written.events,
        "images": written.images,
        "duration_seconds": written.seconds,
        "reordered_events": written.reordered_events,
        "backward_images": written.backward_images,
        "width_px": written.size.width,
        "height_px": written.size.height,
        "light": written.light,
        "notes": "; ".join(written.notes),
    }


if __name__ == "__main__":
    sys.exit(main())
