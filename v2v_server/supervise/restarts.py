"""When a dead worker's successor is started, and when there is no use in another. Pure.

The wait doubles with every death in a row. When the workers die again and again without a single sample being finished,
something is wrong that restarting does not mend.
"""

from __future__ import annotations

from v2v_protocol.errors import WorkerCrashLoop
from v2v_server.broker.blame import Loss

_FIRST_BACKOFF_SECONDS = 0.2
_LONGEST_BACKOFF_SECONDS = 10.0


def crash_budget(workers: int) -> int:
    """Deaths in a row, without any finished sample between them, that so many workers may have."""
    return 3 * workers + 4


class Restarts:
    """Counts deaths in a row."""

    def __init__(self) -> None:
        self._deaths_in_a_row = 0
        self._samples_seen = 0

    def progress(self, samples: int) -> None:
        """So many samples were finished so far; any more than last time forgives earlier deaths."""
        if samples > self._samples_seen:
            self._samples_seen = samples
            self._deaths_in_a_row = 0

    def delay(self, workers: int, loss: Loss) -> float:
        """A worker died.

        Args:
            workers: how many there should be.
            loss: what became of it.

        Returns:
            seconds until its successor may be started.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        self._deaths_in_a_row += 1
        if self._deaths_in_a_row > crash_budget(workers):
            raise WorkerCrashLoop(
                f"{self._deaths_in_a_row} server workers died in a row without finishing a sample (limit "
                f"{crash_budget(workers)}); the last one {loss.text}. What they printed is above; "
                f"`v2v-simulate` on one of the videos shows the same in one process"
            )
        # Capped before the power: hundreds of deaths in a row, as many workers allow, would overflow a float.
        doublings = min(self._deaths_in_a_row - 1, 16)
        return float(min(_FIRST_BACKOFF_SECONDS * 2**doublings, _LONGEST_BACKOFF_SECONDS))
