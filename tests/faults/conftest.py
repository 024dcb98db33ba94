"""The clips, the server, the patience and the check for leftovers of the stream's tests."""

from tests.stream.conftest import _no_process_left, _patient_consumers, clips, corpus, server

__all__ = ["_no_process_left", "_patient_consumers", "clips", "corpus", "server"]
