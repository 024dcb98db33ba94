"""The service as its users meet it: start, stop, bad input, bad peers."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import zmq

from tests.clips import panned_luma, write_clip
from tests.stream.conftest import SMALL, SMALL_FLAGS, epoch_of, server_workers
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.messages import Denied, Hello, Ping, Pong, Want, Welcome, decode, encode
from v2v_server.commands.serve import main as serve
from v2v_server.worker.process import LARGEST_MEMORY_BYTES


@pytest.fixture
def raw(server: LocalServer) -> Iterator[tuple[zmq.Socket[bytes], str]]:
    """A bare socket on a running server, and its address."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.setsockopt(zmq.RCVTIMEO, 60_000)
        dealer.connect(server.address)
        yield dealer, server.address


def _ask(dealer: zmq.Socket[bytes], *frames: bytes) -> object:
    dealer.send_multipart(frames)
    return decode(dealer.recv_multipart()[0])


def test_garbage_on_the_port_does_not_disturb_other_peers(raw: tuple[zmq.Socket[bytes], str]) -> None:
    dealer, address = raw
    host, port = address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as plain:
        plain.sendall(os.urandom(4096))
    for frames in ([b""], [b"\xc1" * 50], [random.Random(0).randbytes(1000)], [b"a", b"b", b"c"], [encode(Pong())[0]]):
        answer = _ask(dealer, *map(bytes, frames))
        assert isinstance(answer, Denied)
        assert answer.code == "malformed"
    assert _ask(dealer, bytes(encode(Ping())[0])) == Pong()
    assert len(epoch_of(address)) == 8


def test_another_protocol_version_is_told_both_numbers(raw: tuple[zmq.Socket[bytes], str]) -> None:
    dealer, _ = raw
    ping = bytes(encode(Ping())[0])
    other = ping.replace(b"\xa1v" + bytes([PROTOCOL_VERSION]), b"\xa1v\x63")
    assert other != ping
    answer = _ask(dealer, other)
    assert isinstance(answer, Denied)
    assert answer.code == "version"
    assert "99" in answer.text
    assert str(PROTOCOL_VERSION) in answer.text


def test_a_refused_want_changes_nothing(raw: tuple[zmq.Socket[bytes], str]) -> None:
    dealer, _ = raw
    hello = Hello({"recipe": SMALL.to_dict()}, ("voxels",), 2, 0)
    welcome = _ask(dealer, *map(bytes, encode(hello)))
    assert isinstance(welcome, Welcome)
    too_many = _ask(dealer, *map(bytes, encode(Want(0, tuple(range(welcome.credit + 1))))))
    assert isinstance(too_many, Denied)
    assert too_many.code == "credit"
    outside = _ask(dealer, *map(bytes, encode(Want(0, (welcome.sequences,)))))
    assert isinstance(outside, Denied)
    assert outside.code == "range"
    dealer.send_multipart(encode(Want(0, (0,))))
    assert len(dealer.recv_multipart()) == 2


def test_every_worker_is_under_a_limit_of_memory(server: LocalServer) -> None:
    def limits() -> set[int]:
        return {worker.rlimit(psutil.RLIMIT_DATA)[0] for worker in server_workers(server.pid)}

    until(lambda: limits() == {LARGEST_MEMORY_BYTES})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_everything_cleanly(clips: Path, tmp_path: Path, number: signal.Signals) -> None:
    port_file = tmp_path / "port"
    server = _start(clips, "--port-file", str(port_file), *SMALL_FLAGS)
    try:
        _wait_for(server, port_file)
        address = port_file.read_text(encoding="utf-8").strip()
        workers = server_workers(server.pid)
        assert len(workers) == 2
        server.send_signal(number)
        assert server.wait(timeout=60) == 0
    finally:
        _end(server)
    assert not psutil.wait_procs(workers, timeout=60)[1]
    assert not port_file.exists()
    with socket.socket() as probe:
        host, port = address.removeprefix("tcp://").split(":")
        assert probe.connect_ex((host, int(port))) != 0


def test_workers_do_not_outlive_a_killed_server(clips: Path, tmp_path: Path) -> None:
    port_file = tmp_path / "port"
    server = _start(clips, "--port-file", str(port_file), *SMALL_FLAGS)
    try:
        _wait_for(server, port_file)
        workers = server_workers(server.pid)
        server.kill()
        server.wait(timeout=60)
    finally:
        _end(server)
    assert not psutil.wait_procs(workers, timeout=60)[1]


BAD_SETTINGS = [
    ([], "--videos is missing"),
    (["--videos", "{clips}", "--set", "tresholds=1"], "unknown recipe key 'tresholds' (did you mean 'threshold'?)"),
    (["--videos", "{clips}", "--recipe", "papper"], "unknown recipe 'papper' (did you mean 'paper'?)"),
    (["--videos", "{clips}", "--bind", "tcp://0.0.0.0:5555"], "--insecure"),
    (["--videos", "{clips}", "--bind", "nonsense"], "--bind 'nonsense': write tcp://HOST:PORT"),
    (["--videos", "{clips}", "--config", "{clips}/none.yaml"], "--config"),
    (["--videos", "{clips}", "--rows", "middle"], "rows"),
    (["--videos", "{clips}", "--workers", "-1"], "--workers: '-1': give a whole number, or LEAST:MOST, from 0 to 4096"),
]
BAD_SURROUNDINGS = [
    (["--videos", "{clips}/nowhere"], "nowhere: there is no such folder"),
    (["--videos", "{empty}"], "no video found"),
    (["--videos", "{clips}", "--set", "crop_width_px=128"], "no video gives a sequence"),
    (["--videos", "{clips}", "--bind", "tcp://127.0.0.1:{taken}"], "Address already in use"),
    (["--videos", "{clips}", "--port-file", "{clips}/no/such/port"], "--port-file"),
]


def _filled_in(arguments: list[str], **names: object) -> list[str]:
    small = ["--set", "voxels_per_clip=4", "--set", "crop_height_px=32"]
    small += [] if "crop_width_px=128" in arguments else ["--set", "crop_width_px=40"]
    return [*(part.format(**names) for part in arguments), *small]


@pytest.mark.parametrize(("arguments", "message"), BAD_SETTINGS)
def test_bad_settings_are_one_clear_line_and_status_2(
    clips: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    status = serve(_filled_in(arguments, clips=clips))
    said = capsys.readouterr().err
    assert status == 2, said
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(("arguments", "message"), BAD_SURROUNDINGS)
def test_a_start_that_cannot_be_ends_with_status_2_and_no_trace(
    clips: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        command = [sys.executable, "-m", "v2v_server", "--bind", "tcp://127.0.0.1:*"]
        command += _filled_in(arguments, clips=clips, empty=tmp_path, taken=taken.getsockname()[1])
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_a_port_file_that_cannot_be_written_is_one_line_and_leaves_nothing(
    clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "port"
    folder.mkdir()
    flags = ["--videos", "{clips}", "--workers", "0", "--bind", "tcp://127.0.0.1:*", "--port-file", "{folder}"]
    assert serve(_filled_in(flags, clips=clips, folder=folder)) == 2
    assert capsys.readouterr().err.endswith(
        f"v2v-serve: --port-file {folder}: it is a folder; give the name of a file\n"
    )
    assert list(tmp_path.iterdir()) == [folder]


def test_the_start_says_which_videos_give_nothing_and_what_would_admit_them(clips: Path, tmp_path: Path) -> None:
    folder = tmp_path / "short"
    folder.mkdir()
    write_clip(folder / "long.mp4", panned_luma(60, 48, 64))
    write_clip(folder / "short.mp4", panned_luma(12, 48, 64))
    (folder / "noise.mp4").write_bytes(os.urandom(500))
    port_file = tmp_path / "port"
    flags = ("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=32")
    server = _start(folder, "--port-file", str(port_file), "--workers", "0", *flags)
    try:
        _wait_for(server, port_file)
    finally:
        server.terminate()
        said = server.communicate(timeout=60)[1]
    assert "2 videos" in said
    assert "1 give 2 sequences of 21 frames" in said
    assert "short.mp4: 12 frames, the recipe needs 21" in said
    assert "voxels_per_clip at most 2" in said
    assert "noise.mp4" in said


def _start(videos: Path, *flags: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "v2v_server", "--videos", str(videos), "--workers", "2"]
    return subprocess.Popen(
        [*command, "--bind", "tcp://127.0.0.1:*", *flags],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wait_for(server: subprocess.Popen[str], port_file: Path) -> None:
    until(lambda: port_file.exists() or server.poll() is not None)
    assert server.poll() is None, server.stderr.read() if server.stderr else ""


def _end(server: subprocess.Popen[str]) -> None:
    if server.poll() is None:
        server.kill()
    server.communicate(timeout=60)
