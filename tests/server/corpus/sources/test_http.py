"""Videos below an HTTP address, whose listing states no sizes, on servers of many manners."""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.clips import panned_luma, write_clip
from tests.digests.rows import Row, samples_of
from v2v_protocol.errors import CorpusError, VideoDenied, VideoGone, VideoUnreadable
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources import copies
from v2v_server.corpus.sources.copies import Bucket

pytest.importorskip("aiohttp", reason="the extra 'cloud' is not installed")
ROW = Row({"bins": 1, "voxels_per_clip": 2}, count=1)


class Web(http.server.ThreadingHTTPServer):
    """Serve a few files in memory, and note the requests.

    Attributes:
        files: content, by path; a text is a listing.
        manner: how sizes are told: "length", "close", "chunked", "no head".
        status: of all answers but those of listings.
        marks: header that names the state of the files, "" for none.
        ranges: whether parts of files can be asked for.
        asked: methods and paths so far.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.url = f"http://127.0.0.1:{self.server_address[1]}"
        self.files: dict[str, bytes | str] = {}
        self.manner, self.marks, self.status = "length", "ETag", 200
        self.ranges = False
        self.asked: list[str] = []


class Answer(http.server.BaseHTTPRequestHandler):
    server: Web
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self.answer(b"")

    def do_GET(self) -> None:
        self.answer(None)

    def answer(self, body: bytes | None) -> None:
        web, path = self.server, self.path
        web.asked.append(f"{self.command} {path}")
        found = web.files.get(path, web.files.get(f"{path}/"))
        is_listing, data = isinstance(found, str), found.encode() if isinstance(found, str) else found or b""
        status = web.status if found is not None and not is_listing else 404 if found is None else 200
        if web.manner == "no head" and body is not None:
            status = 405
        mark, span = hash(data), re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if web.ranges and span and status == 200 and not is_listing:
            status, first, size = 206, int(span[1]), len(data)
            data = data[first : int(span[2]) + 1]
        self.send_response(status)
        if status == 206:
            self.send_header("Content-Range", f"bytes {first}-{first + len(data) - 1}/{size}")
        self.send_header("Content-Type", "text/html" if is_listing else "video/mp4")
        if web.marks and not is_listing:
            self.send_header(web.marks, f'"{mark}"')
        manner = "length" if is_listing or status not in (200, 206) else web.manner
        body = (data if status in (200, 206) else b"") if body is None else body
        if manner == "chunked":
            self.send_header("Transfer-Encoding", "chunked")
            body = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body) if body else b""
        elif manner == "close":
            self.send_header("Connection", "close")
            self.close_connection = True
        else:
            self.send_header("Content-Length", str(len(data) if status in (200, 206) else 0))
        self.end_headers()
        self.wfile.write(body)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("clip") / "a.mp4"
    write_clip(path, panned_luma(20, 32, 40))
    return path.read_bytes()


@pytest.fixture
def web(monkeypatch: pytest.MonkeyPatch) -> Iterator[Web]:
    monkeypatch.setattr(copies, "_FIRST_WAIT_SECONDS", 0.001)
    with Web() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def opened(address: str, tmp_path: Path, **options: Any) -> closing[Catalogue]:
    return closing(open_catalogue(address, cache_dir=tmp_path, copies=tmp_path / "copies", processes=0, **options))


@pytest.mark.parametrize(
    ("manner", "marks"),
    [("length", "ETag"), ("length", ""), ("no head", "Last-Modified"), ("chunked", "Last-Modified"), ("close", "")],
)
def test_a_listing_without_sizes_is_served(web: Web, clip: bytes, tmp_path: Path, manner: str, marks: str) -> None:
    web.manner, web.marks = manner, marks
    links = ("../", "?C=N;O=D", "a.mp4", "/v/b.mp4", f"{web.url}/v/c.mp4", "sub/", "my%20d.mp4", "readme.txt")
    web.files = {"/v/": "".join(f'<a href="{link}">x</a>' for link in links), "/v/sub/": '<a href="e.mp4">e</a>'}
    web.files |= dict.fromkeys(("/v/a.mp4", "/v/b.mp4", "/v/c.mp4", "/v/sub/e.mp4", "/v/my%20d.mp4"), clip)
    with opened(f"{web.url}/v/", tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["a.mp4", "b.mp4", "c.mp4", "my%20d.mp4", "sub/e.mp4"]
        assert samples_of(catalogue, ROW)[0].arrays["voxels"].any()
        digest = catalogue.digest
        catalogue.check("a.mp4", catalogue.videos[0].fingerprint)
    web.asked.clear()
    with opened(f"{web.url}/v", tmp_path) as catalogue:
        assert catalogue.digest == digest
    questions = 0 if manner == "length" else 1
    # Without a size or a mark nothing tells a change: such a file is read at each start.
    assert (web.asked.count("GET /v/a.mp4") > questions) == (not marks and manner != "length")


def test_a_link_with_a_query_is_refused_in_words(web: Web, clip: bytes, tmp_path: Path) -> None:
    web.files = {"/v/": '<a href="a.mp4">a</a><a href="b.mp4?token=0123456789abcdef">b</a>', "/v/a.mp4": clip}
    with opened(f"{web.url}/v/", tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["a.mp4"]
        (refusal,) = catalogue.refusals
    assert (refusal.video, "link with a query" in refusal.reason) == ("b.mp4?token=0123456789abcdef", True)


@pytest.mark.parametrize("manner", ["length", "chunked"])
def test_one_file_is_served_without_a_listing(web: Web, clip: bytes, tmp_path: Path, manner: str) -> None:
    web.manner, web.files = manner, {"/v/a.mp4": clip}
    with opened(f"{web.url}/v/a.mp4", tmp_path) as catalogue:
        assert list(catalogue.videos.ids) == ["a.mp4"]
        assert catalogue.source.name == f"{web.url}/v", "workers open the folder"
        assert samples_of(catalogue, ROW)[0].arrays["voxels"].any()
    assert {each.partition(" ")[2] for each in web.asked} == {"/v/a.mp4"}


def test_one_file_does_not_forget_its_neighbours(web: Web, clip: bytes, tmp_path: Path) -> None:
    web.files = {"/v/": '<a href="a.mp4">a</a><a href="b.mp4">b</a>', "/v/a.mp4": clip, "/v/b.mp4": clip}
    for address in ("/v/", "/v/a.mp4", "/v/"):
        web.asked.clear()
        with opened(web.url + address, tmp_path) as catalogue:
            assert len(catalogue.videos) == (2 if address == "/v/" else 1)
    assert not [each for each in web.asked if each.startswith("GET /v/b")]


@pytest.mark.parametrize(
    ("status", "kind", "why"),
    [
        (404, VideoGone, "there is no such file a.mp4"), (410, VideoGone, "there is no such file a.mp4"),
        (401, VideoDenied, "access is denied"), (403, VideoDenied, "access is denied"),
        (503, VideoUnreadable, "503"),
    ],
)  # fmt: skip
def test_answers_of_servers_are_told_apart(
    web: Web, tmp_path: Path, status: int, kind: type[VideoUnreadable], why: str
) -> None:
    web.status, web.files = status, {"/v/a.mp4": b"1"}
    with pytest.raises(VideoUnreadable) as caught:
        Bucket(f"{web.url}/v").state("a.mp4")
    assert type(caught.value) is kind
    with pytest.raises(CorpusError, match=why), opened(f"{web.url}/v/a.mp4", tmp_path):
        pass


def test_a_server_that_is_down_has_not_lost_its_files() -> None:
    with pytest.raises(VideoUnreadable) as caught:
        Bucket("http://127.0.0.1:9/v").state("a.mp4", tries=1)
    assert type(caught.value) is VideoUnreadable
