"""What is measured of each setting on its clips: what its form costs, and processor time; and how alike samples are.

Everything is measured on the same sequences of the corpus in each form. A lease of each has four views: samples of one
decode, next to each other.

**Errors of a form.** Both sides are the same setting and the same camera, R from exactly decoded frames: the sample's
own draw and noise key, with both thresholds set to the value in question. Hot pixels are left out: they fire alike on
both sides and would make every relative error look small. Summed over all leases, so that a clip weighs as much as it
has events:

    voxel error    sum |V - R| / sum |R|
    count error    (sum |V| - sum |R|) / sum |R|

**Errors at the true rate** are measured on what is rendered from the clips (``rendered``).

**Resemblance.** The course of a sample is its number of events in each bin. Courses of different clips correlate as
well, because every camera begins running and pauses later. The correlation of samples of one decode beyond that is
(r - s) / (1 - s), with r between them and s between different clips.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import DEFAULT_ARRAYS, Needs, SampleParams
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import Voxels
from v2v_server.worker.arrays.context import SampleContext
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making.make import make_sample, sample_context
from v2v_server.worker.making.plan import plan_sample
from v2v_server.worker.making.read import decode_for
from v2v_tools.remake import lease_for
from v2v_tools.tradeoff.report import THRESHOLDS
from v2v_tools.tradeoff.settings import ServeSetting

NOISE_ROW, DRAW_ROW = "another noise seed", "another threshold draw"
_VIEWS = 4
_LEASES_OF_A_CLIP = 2
_ROUNDS = 3


class Leases(NamedTuple):
    """Folder of a form's videos, and leases of four views each."""

    root: Path
    each: Sequence[Lease]


def leases_of(setting: ServeSetting, clips: Catalogue) -> Leases:
    """Return two leases for each clip, or all there are, spread over the corpus in its order; seed 0, epoch 0.

    Raises:
        UsageError: none of the clips is long enough for a sequence.
    """
    spec = dataclasses.replace(setting.spec, samples_per_decode=_VIEWS, sibling_spacing=1, shuffle=False)
    table = SequenceTable(clips.videos, clips.rows, spec)
    if not table.count:
        raise UsageError(f"{setting.name}: none of the clips is long enough for a sequence")
    schedule, count = Schedule(table, spec), min(_LEASES_OF_A_CLIP * len(clips.videos), table.count)
    leases = []
    for index in (number * table.count // count * _VIEWS for number in range(count)):
        leases.append(
            lease_for(
                Request(b"", 0, index), sequence=schedule.candidate(0, 0, index, 0), catalogue=clips, spec=spec, seed=0,
                arrays=DEFAULT_ARRAYS, siblings=tuple(range(index + 1, index + _VIEWS)),
            )
        )  # fmt: skip
    return Leases(clips.folder, leases)


def seen(leases: Leases, number: int, views: int = 1) -> list[SampleContext]:
    """Return the first views of a lease before simulation, without hot pixels, from one decode."""
    lease, contexts = leases.each[number], []
    clip = ClipJob.of(lease)
    for decoded in decode_for(clip, lease.indices[:views], Folder(leases.root)):
        context, _ = sample_context(clip, decoded, Needs(events=True))
        params = dataclasses.replace(context.params, hot_pixel_count=0)
        contexts.append(dataclasses.replace(context, params=params))
    return contexts


def simulated(context: SampleContext, params: SampleParams) -> Voxels:
    """Return what a camera of these parameters sees: voxels [lead voxels + T, bins, H, W] float32."""
    return simulate_clip(
        context.view, params, context.recipe, "float32", context.step_seconds, levels=context.levels,
        signal=context.signal,
    )  # fmt: skip


def compare(voxels: npt.NDArray[Any], reference: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the sums behind the errors, [3]: sum |V - R|, sum |V| and sum |R|. Sums of several pairs can be added.

    Args:
        voxels, reference: [T, bins, H, W] both, signed event counts of any dtype.
    """
    parts = np.subtract(voxels, reference, dtype=np.float64), voxels, reference
    return np.array([np.abs(part, dtype=np.float64).sum() for part in parts])


def accuracy(model: Leases, others: Mapping[str, Leases]) -> dict[str, npt.NDArray[np.float64]]:
    """Return the sums of :func:`compare` for forms of one setting, [thresholds, 3], by name.

    Args:
        model: from exactly decoded frames.
        others: by name; of the same sequences in the same order.

    Returns:
        also under NOISE_ROW the model with the noise of another key, and under DRAW_ROW with the thresholds of another
        sample's draw: the scale for the errors of the others.
    """
    sums = {name: np.zeros((len(THRESHOLDS), 3)) for name in (*others, NOISE_ROW, DRAW_ROW)}
    for number, lease in enumerate(model.each):
        (exact,), drawn = seen(model, number), plan_sample(ClipJob.of(lease), lease.indices[1]).params
        contexts = {name: seen(other, number)[0] for name, other in others.items()}
        for row, threshold in enumerate(np.array(THRESHOLDS, np.float32).tolist()):
            camera = dataclasses.replace(exact.params, threshold_pos=threshold, threshold_neg=threshold)
            noisy = dataclasses.replace(camera, noise_key=drawn.noise_key)
            redrawn = dataclasses.replace(camera, threshold_pos=drawn.threshold_pos, threshold_neg=drawn.threshold_neg)
            made = {name: (context, camera) for name, context in contexts.items()}
            truth = simulated(exact, camera).voxels
            for name, pair in (made | {NOISE_ROW: (exact, noisy), DRAW_ROW: (exact, redrawn)}).items():
                sums[name][row] += compare(simulated(*pair).voxels, truth)
    return sums


def diversity(leases: Leases) -> list[dict[str, Any]]:
    """Return the records of siblings, samples of one decode, and of a batch of different sequences.

    There are none where there is only one lease. ``effective_samples_of_n`` is the number of independent samples that n
    siblings are worth for a mean: n / (1 + (n - 1) r), the design effect of Kish (Survey Sampling, 1965).
    """
    count = len(leases.each)
    if count < 2:
        return []
    contexts = (context for number in range(count) for context in seen(leases, number, _VIEWS))
    courses = [np.abs(simulated(context, context.params).voxels).sum(axis=(2, 3)).ravel() for context in contexts]
    with np.errstate(divide="ignore", invalid="ignore"):  # of a constant course, nothing correlates
        alike = np.nan_to_num(np.corrcoef(np.array(courses, np.float64)))
    lease, view = np.divmod(np.arange(len(alike)), _VIEWS)
    r = float(alike[np.equal.outer(lease, lease) & ~np.eye(len(alike), dtype=bool)].mean())
    s = float(alike[np.equal.outer(view, view) & np.not_equal.outer(lease, lease)].mean())
    beyond = max(0.0, (r - s) / (1.0 - s)) if s < 1.0 else 0.0
    worth = {f"effective_samples_of_{n}": n / (1 + (n - 1) * beyond) for n in (2, 4)}
    return [
        {"measure": "diversity", "name": "siblings", "course_correlation": r, **worth},
        {"measure": "diversity", "name": "batch", "course_correlation": s},
    ]


def making(leases: Leases, samples_per_decode: int) -> Callable[[int], None]:
    """Return the work of a server worker: make all views of a lease, the same samples for 1, 2 or 4 of a decode."""

    def make(number: int) -> None:
        lease = leases.each[number % len(leases.each)]
        job = SampleJob.of(lease)
        for first in range(0, _VIEWS, samples_per_decode):
            indices = lease.indices[first : first + samples_per_decode]
            for index, decoded in zip(indices, decode_for(job.clip, indices, Folder(leases.root)), strict=True):
                make_sample(dataclasses.replace(job, index=index), decoded)

    return make


def cpu_seconds(works: Mapping[str, Callable[[int], None]], leases: int) -> dict[str, float]:
    """Do all works in turns, lease by lease, every other round in reverse order.

    Args:
        works: by name; each makes the views of the lease of a number.
        leases: number of leases.

    Returns:
        processor seconds of a sample: the mean over the leases of each one's fastest round.
    """
    seconds = {name: np.zeros((_ROUNDS, leases)) for name in works}
    for work in works.values():
        work(0)  # files into memory, code compiled
    for turn in range(_ROUNDS):
        for number in range(leases):
            for name in list(works)[:: 1 - 2 * (turn % 2)]:
                begun = time.process_time()
                works[name](number)
                seconds[name][turn, number] = time.process_time() - begun
    return {name: float(taken.min(axis=0).mean()) / _VIEWS for name, taken in seconds.items()}
