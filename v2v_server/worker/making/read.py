"""Read what samples need of a clip: its frames, once for siblings, and the files beside its video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable

from v2v_protocol.errors import SidecarError, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.sample import sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.sidecars import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.store.cache import Cache, Cached
from v2v_server.store.verified import read_unchanged
from v2v_server.video.decode import ClipRequest, DecodedClip, SampleView
from v2v_server.video.picture import MIXED, MOST_BITS, SDR
from v2v_server.worker.job import ClipJob
from v2v_server.worker.making.plan import SamplePlan, plan_sample


@dataclass(frozen=True, slots=True)
class Decoded:
    """The decoded clip of a sample, with its plan, and the frames up to its first one that its pixels start from."""

    plan: SamplePlan
    clip: DecodedClip
    before: DecodedClip | None = None


def decode_for(
    clip: ClipJob, indices: Sequence[int], source: VideoSource, cache: Cache | None = None
) -> tuple[Decoded, ...]:
    """Decode, in one pass, exactly the frames that some samples of a clip need.

    Args:
        clip: what to decode.
        indices: of the samples.
        source: where the videos come from.
        cache: cache of decoded pieces for later epochs; None stores nothing.

    Raises:
        VideoError: the file is not the catalogued one, or cannot deliver the expected frames.
    """
    plans = [plan_sample(clip, index) for index in indices]
    frames = plans[0].frames
    try:
        request = ClipRequest(
            clip.frame_index(frames.span, clip.start_frame - frames.first), frames.first,
            tuple(plan.cut for plan in plans), frames.stride or 1,
            clip.rows.bounds(clip.height_px), _most_bits(clip.spec),
            tuple((clip.seed, clip.epoch, index) for index in indices),
            tuple(SampleView(clip.spec, plan.params, clip.arrays, _moments_before(clip, plan)) for plan in plans),
        )  # fmt: skip
        source.expected = clip.video, clip.state
        with source.open_pixels(clip.video, clip.fingerprint) as pixels:
            if cache is not None and not pixels.is_stored:
                pixels = Cached(pixels, cache, clip.video, clip.fingerprint)
            clips = read_unchanged(pixels, clip.fingerprint, request)
    except VideoError as error:
        # Consumer and log identify videos by id; a path of this host means nothing elsewhere.
        raise type(error)(clip.video, error.frame, error.reason) from error
    if clips[0].signal.transfer == MIXED:
        why = "states different transfer characteristics within a clip: re-encode it with one, or set light to sdr"
        raise VideoError(clip.video, clip.start_frame, why)
    return tuple(
        _divided(_with_its_margin(plan, read), frames.pick(read, int(plan.source[-1]) + 1))
        for plan, read in zip(plans, clips, strict=True)
    )


def _divided(plan: SamplePlan, read: DecodedClip) -> Decoded:
    """Divide what was decoded at the first frame of the clip, which both parts have."""
    if not plan.run_in:
        return Decoded(plan, read)
    frames, seconds, motion = read.frames, read.seconds, read.motion
    clip = replace(
        read, frames=frames[plan.run_in :], seconds=seconds[plan.run_in :],
        motion=None if motion is None else motion[plan.run_in :],
    )  # fmt: skip
    return Decoded(plan, clip, replace(read, frames=frames[: plan.run_in + 1], seconds=seconds[: plan.run_in + 1]))


def _moments_before(clip: ClipJob, plan: SamplePlan) -> tuple[float, ...]:
    """Return when the frames before a rendered clip are seen, seconds since its first one."""
    step_seconds = clip.spec.recipe.frame_stride / (clip.frames_per_second or 1.0)
    return tuple(step_seconds * step for step in range(-plan.run_in, 0))


def _with_its_margin(plan: SamplePlan, clip: DecodedClip) -> SamplePlan:
    """Return the plan with the margin that was read: a still clip has none for sub-steps."""
    if plan.cut.still is None or clip.frames.shape[1:] != plan.cut.still[2:]:
        return plan
    return replace(plan, margin_px=0 if plan.flow is None else plan.flow.margin_px)


def _most_bits(spec: StreamSpec) -> int | None:
    """Return ``most_bits`` of a :class:`ClipRequest`. Pictures between frames are made from 8 bits."""
    if spec.recipe.light == "sdr":
        return None
    return SDR.bits if spec.substep_px else MOST_BITS


class Clips:
    """Decode the clips of samples, together with those of their siblings.

    Args:
        source: where the videos come from.
        cache: cache of decoded pieces for later epochs; None stores nothing.
    """

    def __init__(self, source: VideoSource, cache: Cache | None = None) -> None:
        self._source = source
        self._cache = cache
        self._clip: ClipJob | None = None  # of those that are kept
        self._kept: dict[int, Decoded] = {}

    def take(self, clip: ClipJob, indices: Sequence[int]) -> tuple[Decoded, bool]:
        """Return the decoded clip of the first of these samples, and whether it was decoded just now.

        Args:
            clip: what to decode.
            indices: of the sample, and of its siblings still to come, which are decoded with it and kept.

        Raises:
            VideoError: see :func:`decode_for`.
        """
        if self.has(clip, indices[0]):
            return self._kept.pop(indices[0]), False
        self._clip, self._kept = clip, {}  # siblings that never came
        if len(indices) > 1:
            try:
                first, *others = decode_for(clip, indices, self._source, self._cache)
            except VideoError:
                pass  # a sibling may need more of the clip than this sample; try without siblings
            else:
                self._kept = dict(zip(indices[1:], others, strict=True))
                return first, True
        try:
            return decode_for(clip, indices[:1], self._source, self._cache)[0], True
        except (VideoChanged, VideoUnreadable):
            raise
        except VideoError:
            # A decoder may hide a temporary storage error, so try once more. An error of the file repeats.
            return decode_for(clip, indices[:1], self._source, self._cache)[0], True

    def said_of_cache(self, decoded: Decoded) -> str:
        """Return the cache field of a sample's header, see :class:`v2v_protocol.messages.SampleHeader`."""
        if self._cache is None or decoded.clip.origin == "store":
            return ""
        if decoded.clip.origin == "cache":
            return "hit"
        return f"miss: {self._cache.trouble}" if self._cache.trouble else "miss"

    def has(self, clip: ClipJob, index: int) -> bool:
        """Return whether a sample of a clip needs no decoding."""
        return index in self._kept and self._clip == clip


@contextmanager
def open_sidecars(clip: ClipJob, source: VideoSource) -> Iterator[dict[str, Traversable | None]]:
    """Lend the sidecars that a clip's arrays are made from, by ending, until the end of the context.

    Raises:
        SidecarError: one cannot be read, or differs from the catalogue.
    """
    opened: dict[str, Traversable | None] = dict.fromkeys(sidecar_endings(clip.arrays))
    with ExitStack() as stack:
        for ending, (fingerprint, table) in clip.sidecars.items():
            try:
                id = sidecar_id(clip.video, ending)
                opened[ending] = stack.enter_context(open_sidecar(source, id, fingerprint, table))
            except VideoError as error:
                here = isinstance(error, VideoChanged | VideoUnreadable)
                raise SidecarError(clip.video, ending, error.reason, here) from error
            except MemoryError as error:
                raise SidecarError(clip.video, ending, "reading it takes too much memory") from error
        yield opened
