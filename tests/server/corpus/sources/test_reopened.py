"""A source as another process opens it: the same files, copies, kind and rates."""

from __future__ import annotations

from pathlib import Path

import pytest

from v2v_server.corpus.sources.copies import Bucket, Copies
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.prepared import Prepared
from v2v_server.corpus.sources.source import MANIFEST_NAME, SourceOptions, VideoSource, open_source
from v2v_server.kinds.sequences import SequenceKind

KIND = SequenceKind(25.0, picture_bits=12)


@pytest.mark.parametrize("kind", [Folder, Prepared, Copies])
@pytest.mark.parametrize("name", ["videos", "named like.mp4", "not \udcff UTF-8", "with pictures"])
def test_another_process_opens_the_same_source(kind: type[VideoSource], name: str, tmp_path: Path) -> None:
    root = tmp_path / name
    root.mkdir()
    if name == "with pictures":
        (root / "0.png").touch()  # so that a user who names it names a sequence in the folder above
    if kind is Prepared:
        (root / MANIFEST_NAME).touch()
    bucket = Bucket(f"file://{root}")
    source = Copies(bucket, tmp_path / "copies", 12_345) if kind is Copies else kind(str(root))
    source.kind, source.rates = KIND, {f"{number}/": 24.5 for number in range(70_000)}
    again = VideoSource.from_bytes(source.to_bytes())
    assert type(again) is kind
    assert (again.name, again.kind, again.rates) == (source.name, KIND, source.rates)
    assert again.to_bytes() == source.to_bytes()
    if isinstance(again, Copies):
        assert (again.copies.folder, again.copies.most_bytes, again.bucket.only) == (tmp_path / "copies", 12_345, "")


def test_an_address_of_one_video_is_opened_as_the_address_above_it(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").touch()
    options = SourceOptions(copies=tmp_path / "copies")
    source = open_source(f"file://{tmp_path}/a.mp4", options)
    again = VideoSource.from_bytes(source.to_bytes())
    assert isinstance(again, Copies)
    assert (again.name, again.bucket.url, again.bucket.only) == (source.name, f"file://{tmp_path}", "")


def test_a_source_has_ten_methods_beside_reopening() -> None:
    """So that one more kind of source is one more file."""
    own = {name for name in vars(VideoSource) if callable(getattr(VideoSource, name)) and name[0] != "_"}
    assert len(own - {"to_bytes", "from_bytes"}) <= 10, own
