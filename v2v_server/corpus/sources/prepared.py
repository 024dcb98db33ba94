"""A prepared folder: the files that v2v-prepare made, under the ids of their sources."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cached_property

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.manifest import MANIFEST_NAME, Manifest, prepared_name, read_manifest
from v2v_server.corpus.sources.folder import Folder, locate
from v2v_server.corpus.sources.source import SourceOptions
from v2v_server.video.rows import Rows


class Prepared(Folder):
    """A folder with a manifest, which says what its files are."""

    @cached_property
    def manifest(self) -> Manifest:
        """Return the manifest; only the process that lists the videos reads it.

        Raises:
            CorpusError: it cannot be read, or makes no sense.
        """
        return read_manifest(self.folder)

    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the videos of the manifest; other files are passed over."""
        known = self.manifest.videos
        for id in sorted(known) if self.listed is None else [entry.id for entry in self.listed]:
            if id in known:
                yield id
            else:
                refused[id] = (
                    "is not in the prepared folder's manifest: the source had no such usable video, or the last "
                    "v2v-prepare was not asked for it; run it once for all of them"
                )

    def file_of(self, id: str) -> str:
        """Return the path of the prepared file."""
        return prepared_name(id)

    def rows(self, asked: Rows | None) -> Rows:
        """Return which rows of the pictures may be used.

        A folder that stores all rows may be served with any rows, another one only with its stored rows.

        Raises:
            CorpusError: the folder is not finished, or lacks requested rows.
        """
        header, done = self.manifest.header, len(self.manifest.videos)
        if done != header.videos:
            raise CorpusError(
                f"{self}: {done} of {header.videos} videos are prepared; run v2v-prepare again to finish (what is done "
                "is kept)"
            )
        kept = Rows.parse(header.rows)
        if asked is None or asked == Rows():
            return kept
        if kept not in (Rows(), asked):
            raise CorpusError(
                f"{self}: rows {asked} asked for, but this prepared folder holds rows {header.rows} of its source "
                "only; leave --rows out, or serve the source"
            )
        return asked


def open_source(name: str, options: SourceOptions) -> Prepared | None:
    """Open a prepared folder; None for any other.

    Raises:
        CorpusError: the folder is a part of a prepared one.
        OSError: this user may not look at it.
    """
    root, listed = locate(name, options)
    for folder in root.parents:
        if (folder / MANIFEST_NAME).exists():
            raise CorpusError(
                f"{root} lies in the prepared folder {folder}, where its manifest is: name that folder, and restrict "
                "it by a list file"
            )
    return Prepared(root, listed) if (root / MANIFEST_NAME).exists() else None
