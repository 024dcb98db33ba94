"""A stream from a bucket of a real object server (moto's, on this host): the same bytes, each video fetched once."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from bench.processes import free_ports
from tests.packed import pack
from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_server.corpus.catalogue import open_catalogue

# Looked for, not imported: the fast tests are collected without them.
missing = [name for name in ("moto", "s3fs") if find_spec(name) is None]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}"),
]

URL = "s3://corpus/videos"


def _server_at(host: str, port: int) -> Any:
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address=host, port=port, verbose=False)
    server.start()
    return server


class Bucket:
    """The server, what was fetched from it, and the files of the bucket."""

    def __init__(self) -> None:
        self.fetched: list[str] = []
        self.asked: list[str] = []
        self._server = _server_at("127.0.0.1", free_ports(1)[0])  # which it gets again after a pause
        host, port = self._server.get_host_and_port()
        self.address = f"http://{host}:{port}"
        handler = logging.Handler()
        handler.emit = self._note  # type: ignore[method-assign]
        logging.getLogger("werkzeug").setLevel(logging.INFO)
        logging.getLogger("werkzeug").addHandler(handler)
        self._handler = handler

    def _note(self, record: logging.LogRecord) -> None:
        self.asked.append(record.getMessage())
        found = re.search(r'"?GET /corpus/videos/([^? ]+)(\?\S*)? HTTP', record.getMessage())
        if found:
            self.fetched.append(unquote(found[1]))

    def client(self) -> Any:
        import boto3

        return boto3.client("s3", endpoint_url=self.address, region_name="us-east-1")

    def fill(self, folder: Path, below: str = "videos") -> None:
        client = self.client()
        client.create_bucket(Bucket="corpus")
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                client.upload_file(str(path), "corpus", f"{below}/{path.relative_to(folder).as_posix()}")
        self.fetched.clear()
        self.asked.clear()

    def pause(self) -> None:
        """Stop answering."""
        self._server.stop()

    def go_on(self) -> None:
        host, _, port = self.address.removeprefix("http://").rpartition(":")
        self._server = _server_at(host, int(port))

    def stop(self) -> None:
        logging.getLogger("werkzeug").removeHandler(self._handler)
        self._server.stop()


@pytest.fixture
def bucket(clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    for name, value in {
        "AWS_ACCESS_KEY_ID": "test-key", "AWS_SECRET_ACCESS_KEY": "test-secret", "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true", "V2V_CACHE_DIR": str(tmp_path / "cache"), "AWS_CONFIG_FILE": "/none",
        "AWS_SHARED_CREDENTIALS_FILE": "/none",
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    running = Bucket()
    monkeypatch.setenv("AWS_ENDPOINT_URL", running.address)
    try:
        running.fill(clips)
        yield running
    finally:
        running.stop()


def digests(address: str, epoch: int) -> list[str]:
    return [digest(batch) for batch in epoch_of(address, epoch=epoch)]


def stream_of(server: LocalServer) -> V2VStreamDataset:
    return V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3)


def forget_copies(tmp_path: Path) -> None:
    """As on another host, which has the index only."""
    shutil.rmtree(tmp_path / "cache" / "copies")
    (tmp_path / "cache" / "copies" / "partial").mkdir(parents=True)


def all_lines(server: LocalServer) -> str:
    assert server._errors is not None
    return os.pread(server._errors.fileno(), 1 << 20, 0).decode(errors="replace")


def test_the_bytes_are_those_of_the_folder_and_each_video_is_fetched_once(
    clips: Path, bucket: Bucket, tmp_path: Path
) -> None:
    ids = sorted(path.relative_to(clips).as_posix() for path in clips.rglob("*") if path.is_file())
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as local:
        reference = [digests(local.address, epoch) for epoch in range(2)]
    with LocalServer(URL, workers=2, flags=SMALL_FLAGS) as server:
        assert sorted(bucket.fetched) == ids, "the catalogue fetches each video once"
        assert [digests(server.address, epoch) for epoch in range(2)] == reference
        state = next(iter(stream_of(server))).resume_state
    assert len(bucket.fetched) == len(ids), "workers find the copies"
    forget_copies(tmp_path)
    bucket.fetched.clear()
    with LocalServer(URL, workers=3, flags=SMALL_FLAGS) as server:
        assert bucket.fetched == [], "the ETags say that nothing changed"
        resumed = stream_of(server)
        resumed.load_state_dict(state)
        assert list(map(digest, resumed)) == reference[0][1:], "a server started again goes on in mid-epoch"
        assert sorted(bucket.fetched) == ids, "workers of one host fetch each video once"
        assert digests(server.address, 1) == reference[1]
        assert len(bucket.fetched) == len(ids), "the second epoch fetches nothing"


def test_a_store_that_is_away_condemns_no_video(clips: Path, bucket: Bucket, tmp_path: Path) -> None:
    with LocalServer(clips, workers=1, flags=SMALL_FLAGS) as local:
        reference = digests(local.address, 0)
    with LocalServer(URL, workers=1, flags=SMALL_FLAGS) as server, ThreadPoolExecutor(1) as thread:
        forget_copies(tmp_path)
        bucket.pause()
        epoch = thread.submit(digests, server.address, 0)
        until(lambda: "which is not known to be gone or changed: the store gives no answer" in all_lines(server))
        bucket.go_on()
        assert epoch.result(120) == reference
        assert "passed over" not in all_lines(server)


def test_a_tar_of_600_members_is_one_question_to_list_one_to_index_and_one_a_member(
    clips: Path, bucket: Bucket, tmp_path: Path
) -> None:
    """Half of them are videos. The samples are those of the files unpacked."""
    below, videos = tmp_path / "plain" / "0", [path for path in sorted(clips.rglob("*")) if path.is_file()]
    below.mkdir(parents=True)
    for number in range(300):
        shutil.copy(videos[number % len(videos)], below / f"{number:03}{videos[number % len(videos)].suffix}")
        (below / f"{number:03}.txt").write_text("a caption")
    pack(below, tmp_path / "tar" / "0.tar")
    bucket.fill(tmp_path / "tar", "tar")
    cache = tmp_path / "cache"
    with (
        closing(open_catalogue(below.parent, cache_dir=cache)) as plain,
        closing(open_catalogue("s3://corpus/tar", cache_dir=cache, processes=2)) as packed,
    ):
        assert (packed.digest, len(packed.videos)) == (plain.digest, 300)
    assert questions(bucket) == {"GET /corpus": 1, "GET /corpus/tar/0.tar": 1 + 300}
    forget_copies(tmp_path)
    bucket.asked.clear()
    found = {}
    for source in (below.parent, "s3://corpus/tar"):
        with LocalServer(source, workers=2, flags=SMALL_FLAGS) as server:
            found[source] = list(map(digest, islice(stream_of(server), 6)))
    assert len(set(map(tuple, found.values()))) == 1
    asked = questions(bucket)
    assert asked.keys() == {"GET /corpus", "GET /corpus/tar/0.tar"}, "workers need no table, and ask nothing else"
    assert asked["GET /corpus"] == 1


def questions(bucket: Bucket) -> Counter[str]:
    return Counter(re.sub(r".*(GET|HEAD) (/corpus[^? ]*).* HTTP.*", r"\1 \2", text) for text in bucket.asked)
