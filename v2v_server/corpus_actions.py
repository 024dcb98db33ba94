"""Carry out the dispatcher's actions that need the corpus, and report the results to it. I/O."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

from v2v_protocol.errors import CorpusError, IndexUnreadable, V2VError, VideoChanged, VideoError, VideoGone
from v2v_protocol.messages import encode
from v2v_server.broker.actions import Action, AddToQuarantine, CheckVideo, SendLease, ToWorker
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.worker_registry import REST_SECONDS, clean_name
from v2v_server.corpus.catalogue import Catalogue, complete_lease
from v2v_server.quarantine.file import write_entry
from v2v_server.quarantine.snapshots import Quarantine, QuarantineEntry

_RECORD_SECONDS = 2.0
"""Longest time to retry writing a quarantine entry while another process writes to the file."""


class CorpusActions:
    """Complete leases, write quarantine entries, and check videos that a worker could not read.

    Args:
        catalogue: the videos.
        dispatcher: gets the results.
        quarantine: the snapshots.
        quarantine_file: file that new entries are written to.
        clock: returns the time, seconds.
        say: writes a log line: text, level, the request that it is about, and additional fields for programs.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        dispatcher: Dispatcher,
        quarantine: Quarantine,
        quarantine_file: Path,
        clock: Callable[[], float],
        say: Callable[..., None],
    ) -> None:
        self._catalogue = catalogue
        self._dispatcher = dispatcher
        self._quarantine = quarantine
        self._quarantine_file = quarantine_file
        self._clock = clock
        self._say = say
        self._warned = -math.inf
        self._unrecorded: list[tuple[AddToQuarantine, float]] = []  # until when each is tried

    def complete(self, grant: SendLease, todo: deque[Action]) -> list[Action]:
        """Return the message of a lease, complete; if it cannot be completed, what the dispatcher does about it.

        Args:
            grant: the lease.
            todo: later actions; leases among them are dropped if the index cannot be read at the moment.
        """
        try:
            return [ToWorker(grant.worker, encode(complete_lease(grant.lease, self._catalogue, grant.spec)))]
        except IndexUnreadable as error:
            unsent = [grant, *(each for each in todo if isinstance(each, SendLease))]
            later = [each for each in todo if not isinstance(each, SendLease)]
            todo.clear()
            todo.extend(later)
            self._dispatcher.index_unreadable(unsent, str(error), self._clock())
            return []
        except V2VError as error:
            return self._dispatcher.lease_refused(grant, str(error), self._clock())

    def record(self, record: AddToQuarantine, until: float | None = None) -> list[Action]:
        """Write a quarantine entry. If that fails, the server continues and logs the consequence.

        Args:
            record: the entry.
            until: time until which :meth:`retry` repeats it while another process writes; None: for a short time.

        Returns:
            what the dispatcher does about it; nothing while it is retried.
        """
        entry, now = record.entry, self._clock()
        until = now + _RECORD_SECONDS if until is None else until
        latest = self._quarantine.latest
        if self._quarantine.refusal(latest, entry.path, entry.fingerprint, entry.frame, entry.spec) is not None:
            # Another worker ended over it while the file was locked. A second entry would refuse the whole video.
            return self._dispatcher.quarantine_recorded(record, [], now)
        written: list[QuarantineEntry] = []
        try:
            written = write_entry(self._quarantine_file, entry, self._quarantine, wait_seconds=0.0)
        except (OSError, CorpusError) as error:
            if isinstance(error, BlockingIOError) and now < until:
                self._unrecorded.append((record, until))
                return []
            self._say(
                f"{entry.path} from frame {entry.frame}: {entry.reason}; the sequence is skipped once and will "
                f"be tried again, because the quarantine cannot be written: {error}",
                "error",
                record.request,
                video=entry.path,
            )
        for line in written:
            self._say(f"quarantine: {line}", "warning", record.request, video=line.path)
        return self._dispatcher.quarantine_recorded(record, written, now)

    def retry(self) -> list[Action]:
        """Repeat the writing of entries that another process delayed. Call a few times a second."""
        unrecorded, self._unrecorded = self._unrecorded, []
        return [action for record, until in unrecorded for action in self.record(record, until)]

    def check_video(self, missing: CheckVideo) -> bool:
        """Check the file against the catalogue. If it matches, warn (rate-limited, since all workers of a host fail
        alike) that the worker's host does not have it.
        """
        try:
            self._catalogue.check(missing.video, missing.fingerprint, missing.sidecar)
        except (VideoChanged, VideoGone):
            if not missing.sidecar:
                self._catalogue.mark_stale(missing.video)
            return False
        except (VideoError, CorpusError):
            return False
        now = self._clock()
        if now >= self._warned + REST_SECONDS:
            self._warned = now
            name = clean_name(self._dispatcher.registry.name_of(missing.identity))
            is_local = self._catalogue.source.is_local
            file = f"the sidecar {missing.sidecar} of {missing.video}" if missing.sidecar else missing.video
            self._say(
                f"worker {name} failed on {file}, which "
                f"{'is on this host as catalogued' if is_local else 'is not known to be gone or changed'}: "
                f"{missing.reason}; other workers make the sample, and this one gets no work for {REST_SECONDS:g} s. "
                "Check --videos on its host",
                "warning",
                missing.request,
                video=missing.video,
            )
        return True
