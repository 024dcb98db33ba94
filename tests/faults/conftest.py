"""The clips, the server and the check for leftovers of the stream's tests."""

from tests.stream.conftest import _no_process_left, clips, server

__all__ = ["_no_process_left", "clips", "server"]
