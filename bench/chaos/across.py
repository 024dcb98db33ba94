"""Run the chaos bench between two hosts, over a cable that loses packets and is cut again and again.

    python -m bench chaos_across --footage VIDEO VIDEO --minutes 2 --loss 0.01 --delay-ms 5 --keys

Two network namespaces (`bench/cable.py`): the server is on one; consumers and further workers are on the other, and
samples travel compressed. A cut lasts up to 4 s. Tables and bars are those of `python -m bench chaos`.
"""

from __future__ import annotations

import argparse
import random
from dataclasses import dataclass, replace

from bench.cable import NEAR, Cable
from bench.chaos import chaos
from bench.chaos.faults import Chaos
from bench.chaos.fleet import Fleet
from bench.corpus import run_folder
from bench.frame import Report, add_positive, chosen
from v2v_protocol.command import Parser

IN_OWN_NETWORK = True
_KINDS = ("worker-kill", "further-add", "further-kill", "further-term", "server-kill", "consumer-kill")
_LONGEST_CUT_SECONDS = 4.0


@dataclass(slots=True, kw_only=True)
class Cutting(Chaos):
    """Faults, and a cable that is cut and healed in turns."""

    cable: Cable
    cuts: int = 0
    _is_cut: bool = False
    _turn_at: float | None = None

    def act(self, now: float) -> None:
        """Do what is due."""
        Chaos.act(self, now)
        if self._turn_at is None or now >= self._turn_at:
            self._is_cut = self._turn_at is not None and not self._is_cut
            self.cable.set_cut(self._is_cut)
            self.cuts += self._is_cut
            lasts = random.uniform(0.2, _LONGEST_CUT_SECONDS)
            self._turn_at = now + (lasts if self._is_cut else random.expovariate(1.0 / (2 * self.mean_seconds)))

    def end(self) -> None:
        """End all faults."""
        Chaos.end(self)
        self.cable.set_cut(False)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    chaos.add_flags(parser)
    add_positive(parser, "--mbit", 1000.0, "rate of the link, Mbit/s")
    add_positive(parser, "--delay-ms", 5.0, "delay of each direction, ms")
    add_positive(parser, "--loss", 0.01, "share of packets that are lost")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    kinds = chosen(asked.faults, _KINDS, "--faults")
    with run_folder(asked) as (folder, videos), Cable(asked.mbit, asked.delay_ms, asked.loss) as cable:
        fleet = Fleet(
            folder / "run", videos, asked.workers, asked.consumers, chaos.LEASE_SECONDS,
            server_flags=() if asked.keys else ("--insecure",), host=NEAR, elsewhere=cable.far, keyed=asked.keys,
        )  # fmt: skip
        fleet.add_worker()  # it waits for the server
        cutting = Cutting(fleet, asked.every, asked.seed, 0, kinds, cable=cable)
        report = chaos.run_fleet(fleet, cutting, asked)
        passed, lost = cable.count()
    return replace(report, lines=[f"the cable: {passed} packets passed, {lost} lost, {cutting.cuts} cuts"])
