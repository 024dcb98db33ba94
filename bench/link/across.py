"""The chaos test between two hosts: the server on one, consumers and workers on another, and the cable between them
loses packets and is pulled out again and again.

    v2v-bench chaos_across --footage VIDEO VIDEO --minutes 2 --loss 0.01 --delay-ms 5 --keys

Two network namespaces (`bench/link/cable.py`). What is counted, and what must be 0, is what `v2v-bench chaos` says;
consumers and further workers reach the server by the cable only, and samples travel compressed; with ``--keys``
encrypted, too. A cut lasts up to 4 s.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.chaos.chaos import parser_of_chaos, torment_and_judge
from bench.chaos.faults import Chaos
from bench.chaos.fleet import Fleet
from bench.corpus import webvid_like
from bench.link.cable import NEAR, Cable, apart
from bench.records import run
from v2v_protocol.errors import UsageError

_KINDS = ("worker-kill", "further-add", "further-kill", "further-term", "server-kill", "consumer-kill")
_LONGEST_CUT_SECONDS = 4.0


@dataclass(slots=True)
class Cutting(Chaos):
    """Faults, among them a cable that is pulled out and put in again.

    Attributes:
        cable: it.
        cuts: so far.
    """

    cable: Cable | None = None
    cuts: int = 0
    _turn_at: float = 0.0
    _is_cut: bool = False

    def act(self, now: float) -> None:
        """Does what is due."""
        Chaos.act(self, now)
        if self.cable is None or now < self._turn_at:
            return
        if self._is_cut or not self._turn_at:
            self.cable.heal()
            self._turn_at = now + random.expovariate(1.0 / (2 * self.mean_seconds))
        else:
            self.cable.cut()
            self.cuts += 1
            self._turn_at = now + random.uniform(0.2, _LONGEST_CUT_SECONDS)
        self._is_cut = self.cuts > 0 and not self._is_cut

    def end(self) -> None:
        """No more faults."""
        Chaos.end(self)
        if self.cable is not None:
            self.cable.heal()


def _work(asked: argparse.Namespace) -> int:
    folder = Path(tempfile.mkdtemp(prefix="v2v-chaos-")) if asked.keep is None else asked.keep
    try:
        videos = asked.videos
        if videos is None:
            videos = folder / "clips"
            webvid_like(asked.footage, videos, gop=12, frames=300, clips=len(asked.footage))
        with Cable(asked.mbit, asked.delay_ms, asked.loss) as cable:
            fleet = Fleet(
                folder, videos, asked.workers, asked.consumers, asked.lease_deadline_seconds,
                server_flags=() if asked.keys else ("--insecure",), host=NEAR, elsewhere=cable.far, keyed=asked.keys,
            )  # fmt: skip
            kinds = tuple(asked.faults.split(",")) if asked.faults else _KINDS
            if unknown := set(kinds) - set(_KINDS):
                raise UsageError(f"--faults {','.join(sorted(unknown))}: choose from {', '.join(_KINDS)}")
            fleet.add_worker()  # it waits for the server
            chaos = Cutting(fleet, asked.every, asked.seed, 0, kinds, cable=cable)
            began = time.monotonic()
            status = torment_and_judge(fleet, chaos, asked)
            passed, lost = cable.count()
        minutes = (time.monotonic() - began) / 60
        print(f"the cable: {passed} packets passed, {lost} lost, {chaos.cuts} cuts in {minutes:.1f} min")
        return status
    finally:
        if asked.keep is None:
            shutil.rmtree(folder)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of_chaos(__doc__, "v2v-bench chaos_across")
    parser.add_argument("--mbit", type=float, default=1000.0, help="of the link (default 1000)")
    parser.add_argument("--delay-ms", type=float, default=5.0, help="of each direction (default 5)")
    parser.add_argument("--loss", type=float, default=0.01, help="share of packets that are lost (default 0.01)")
    given = sys.argv[1:] if arguments is None else list(arguments)

    def work(asked: argparse.Namespace) -> int:
        status = apart("bench.link.across", given)
        return _work(asked) if status is None else status

    return run(parser, work, given)


if __name__ == "__main__":
    sys.exit(main())
