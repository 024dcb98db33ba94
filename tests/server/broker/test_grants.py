"""What a worker answers is inspected before it is passed on."""

from __future__ import annotations

import numpy as np
import pytest

from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import encode_sample
from v2v_protocol.sample import Form
from v2v_server.broker.dispatcher import check_result
from v2v_server.broker.leases import Request

SIZE = 1000
FORM = Form.of({"voxels": ("int8", (SIZE,))})


@pytest.mark.parametrize(
    ("length", "passes"),
    [(1, True), (SIZE, True), (SIZE + SIZE // 256 + 64, True), (SIZE + SIZE // 256 + 65, False), (0, False)],
)
def test_a_packed_array_is_bounded_by_what_incompressible_bytes_take(length: int, passes: bool) -> None:
    payload = encode_sample(
        epoch=0,
        index=0,
        arrays={"voxels": np.zeros(SIZE, np.int8)},
        provenance={},
        worker="w",
        cpu_seconds=0.0,
        pack=lambda _: bytes(length),
    )
    request = Request(b"consumer", 0, 0)
    if passes:
        assert check_result(payload, request, FORM).packed
    else:
        with pytest.raises(ProtocolError, match="sizes"):
            check_result(payload, request, FORM)
