"""Choose the delay before a dead worker is replaced, and decide when another start does not help. Pure.

The delay doubles with every death in a row. If the workers die repeatedly and not one sample is finished, something is
wrong that restarting does not repair.
"""

from __future__ import annotations

from v2v_protocol.errors import WorkerCrashLoop
from v2v_server.broker.blame import Loss

_FIRST_BACKOFF_SECONDS = 0.2
_LONGEST_BACKOFF_SECONDS = 10.0


def crash_budget(workers: int) -> int:
    """Return how many deaths in a row, without any finished sample between them, this number of workers may have."""
    return 3 * workers + 4


class Restarts:
    """Count deaths in a row."""

    def __init__(self) -> None:
        self._deaths_in_a_row = 0
        self._samples_seen = 0

    def progress(self, samples: int) -> None:
        """Update the number of samples finished so far; any increase resets the count of deaths."""
        if samples > self._samples_seen:
            self._samples_seen = samples
            self._deaths_in_a_row = 0

    def delay(self, workers: int, loss: Loss) -> float:
        """Count a death.

        Args:
            workers: number of workers that there should be.
            loss: what happened to the worker.

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
        # Bounded before the power: a large pool may have hundreds of deaths in a row, which would overflow a float.
        doublings = min(self._deaths_in_a_row - 1, 16)
        return float(min(_FIRST_BACKOFF_SECONDS * 2**doublings, _LONGEST_BACKOFF_SECONDS))
