"""What a person reads: the summary, the live line, and the rates behind it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

from tests.server.corpus import SMALL, SMALL_SPEC, NamedCorpus, corpus, video
from tests.server.peers import peers
from tests.server.status.services import service
from v2v_protocol.refusal import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.counters import Counters
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.videos import VideoEntry
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.status.line import StatusLine, summary
from v2v_server.status.log import StatusLog
from v2v_server.status.state import CacheState, ServiceState
from v2v_server.status.terminal import StatusBlock, make_status
from v2v_server.system.log import Log
from v2v_server.video.rows import Rows


def lines(catalogue: Catalogue, spec: StreamSpec = SMALL_SPEC) -> list[str]:
    return summary(catalogue, spec, SequenceTable(catalogue.videos, catalogue.rows, spec))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


# --- summary ----------------------------------------------------------------------------------------------------------


def test_a_corpus_without_trouble_is_one_line() -> None:
    assert lines(corpus(video("a.mp4"), video("b.mp4", frames=9), rows="top:0.75")) == [
        "2 videos in /corpus: 2 give 12 sequences of 5 frames (at most 10 a video), rows top:0.75"
    ]


def test_refusals_name_reason_and_remedy() -> None:
    said = lines(corpus(video("a.mp4"), video("short.mp4", frames=4), video("small.mp4", height_px=5)))
    assert said[0].startswith("3 videos in /corpus: 1 give 10 sequences")
    assert said[1:] == [
        "2 videos give none under the server's own recipe:",
        "  short.mp4: 4 frames, the recipe needs 5; would admit it: voxels_per_clip at most 1",
        "  small.mp4: picture 16x5 after rows full, the crop is 8x8; "
        "would admit it: resize_scale up to 1.6, or a smaller crop",
        "  with --set voxels_per_clip=N (now the longest that fits is 1): 1 admits 1 of them",
    ]


def test_many_refusals_are_counted_and_a_length_of_clip_named_that_admits_them() -> None:
    lengths = (15, 11, 11, 8, 8, 8, 6)  # SMALL spends two bins of one frame on a voxel grid
    shorts: list[VideoEntry] = [video(f"s{number}.mp4", frames) for number, frames in enumerate(lengths)]
    spec = replace(SMALL_SPEC, recipe=replace(SMALL, voxels_per_clip=10))
    said = lines(corpus(*shorts, video("still.mp4", frames=1), video("good.mp4")), spec)
    assert said[1] == "8 videos give none under the server's own recipe:"
    assert said[-2] == "  ... and 3 more: --list-refused names all"
    assert len(said) == 2 + 5 + 2
    # The middle one of those seven has room for three voxel grids, and all of them for two.
    assert said[-1] == "  with --set voxels_per_clip=N (now the longest that fits is 7): 3 admits 6, 2 admits 7 of them"


def test_files_that_cannot_be_used_are_named() -> None:
    problems = tuple(Refusal(f"p{number}.mp4", None, "has no video track") for number in range(7))
    named = NamedCorpus((video("a.mp4"),), Rows(), problems, Path("/elsewhere"))
    said = lines(named)  # type: ignore[arg-type]
    assert said[0].startswith("1 videos in /elsewhere: 1 give 10 sequences")
    assert said[1:] == [
        "7 files cannot be used at all:",
        *(f"  p{number}.mp4: has no video track" for number in range(5)),
        "  ... and 2 more: --list-refused names all",
    ]
    table = SequenceTable(named.videos, named.rows, SMALL_SPEC)
    every = summary(named, SMALL_SPEC, table, list_refused=True)  # type: ignore[arg-type]
    assert every[2:] == [f"  p{number}.mp4: has no video track" for number in range(7)]


# --- the live line ----------------------------------------------------------------------------------------------------


def said(state: ServiceState, out: io.StringIO | None = None) -> str:
    """What the line says of a state, in a log."""
    stream = io.StringIO() if out is None else out
    StatusLine(stream).show(0.0, state)
    return stream.getvalue().removesuffix("\n")


def test_the_line_counts_what_happened() -> None:
    at = peers()
    seen = service(at)
    before = seen.state()
    at.join()
    at.hello(batch_size=2)
    at.want(0, 1, 2, 3)
    at.finish()
    at.finish()
    at.now = 10.0
    assert said(before) == (
        "0.00 batches/s  0.0 samples/s  workers 0/0  consumers 0  queue 0  faults 0  total 0 samples"
    )
    assert said(seen.state()) == (
        "0.10 batches/s  0.2 samples/s  workers 1/1  consumers 1  queue 0  faults 0  total 2 samples"
    )


def test_a_log_gets_a_line_every_ten_seconds_and_none_of_a_terminals_signs() -> None:
    out, state = io.StringIO(), service(peers()).state()
    line = StatusLine(out)
    assert line.is_due(100.0)
    line.show(100.0, state)
    assert not line.is_due(109.9)
    assert line.is_due(110.0)
    line.interrupt()
    line.close()
    assert out.getvalue() == said(state) + "\n"


def test_workers_that_start_and_those_of_other_hosts_are_counted() -> None:
    at = peers()
    for number in range(3):
        at.join(b"remote%d" % number)
    assert "workers 3/3" in said(service(at).state())
    assert "workers 3/7" in said(replace(service(at).state(), worker_processes=7))


def test_shared_decodes_shared_memory_and_the_cache_are_named_where_there_are_any() -> None:
    at = peers()
    at.dispatcher.counters.samples, at.dispatcher.counters.decodes = 30, 12
    at.dispatcher.counters.in_slots, at.dispatcher.counters.cache_hits, at.dispatcher.counters.cache_misses = 15, 9, 3
    text = said(service(at).state())
    assert "2.5 a decode  50% by shared memory  cache 75% hits  workers" in text
    cache = CacheState("/cache", 1.5, 4.0, 9, 3, "no room")
    assert "cache 75% hits, 1.50 of 4 GiB (no room)  workers" in said(replace(service(at).state(), cache=cache))


def test_a_terminal_shows_a_few_lines_in_the_place_of_those_before() -> None:
    at = peers()
    out = Terminal()
    block = StatusBlock(out)
    watched = service(at)
    block.show(0.0, watched.state())
    first = out.getvalue()
    assert "Nobody is connected" in first
    assert not block.is_due(0.4)
    assert block.is_due(0.5)
    at.join()
    at.hello(batch_size=2)
    at.want(0, 1)
    at.finish()
    block.show(0.6, watched.state())
    second = out.getvalue().removeprefix(first)
    assert second.startswith(f"\x1b[{first.count(chr(10))}F\x1b[J")
    assert "1 consumers" in second
    assert "1/50" in second
    block.interrupt()
    assert out.getvalue().endswith(f"\x1b[{second.count(chr(10))}F\x1b[J")
    block.close()
    block.interrupt()
    assert out.getvalue().count("\x1b[J") == 2


def test_a_hostile_name_does_not_steer_the_terminal() -> None:
    state = service(peers()).state()
    out = Terminal()
    StatusBlock(out).show(0.0, replace(state, waiting=replace(state.waiting, sentence="a\x1b[2Jb")))
    assert "\x1b[2J" not in out.getvalue()


def test_which_it_is_depends_on_where_it_goes() -> None:
    assert isinstance(make_status(Log(), Terminal()), StatusBlock)
    assert isinstance(make_status(Log(), io.StringIO()), StatusLine)
    assert isinstance(make_status(Log(is_json=True), Terminal()), StatusLog)


# --- metrics ----------------------------------------------------------------------------------------------------------


def test_faults_are_all_that_went_wrong() -> None:
    counters = Counters(samples=9, refused_candidates=1, unavailable=2, workers_lost=4, malformed=8, late_results=16)
    assert counters.faults == 15
    assert replace(counters, returned_leases=5).faults == 15
