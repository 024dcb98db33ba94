"""Motion of some cells, as of all."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.rendered import rendered_scene
from v2v_server.motion import Cells, MotionOfCuts, Pyramid, motions
from v2v_server.video.decode import Cut


@settings(deadline=None, max_examples=25)
@given(
    st.sampled_from(("gravel", "parallax", "thin", "flicker")), st.sampled_from((0.0, 1.5, 9.0)),
    st.integers(9, 230), st.integers(9, 230), st.data(),
)  # fmt: skip
def test_the_motion_of_cuts_is_that_of_the_whole_pictures(
    name: str, px: float, height: int, width: int, data: st.DataObject
) -> None:
    pictures = rendered_scene(name, 230, 230, 30 * px).frames(30, 3)[:, :height, :width]
    whole = motions(pictures)
    rows, columns = whole.shape[2:]
    cuts = []
    for _ in range(data.draw(st.integers(1, 3))):
        top, left = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
        size = data.draw(st.integers(1, rows - top)), data.draw(st.integers(1, columns - left))
        cuts.append(Cut(data.draw(st.integers(1, 3)), cells=Cells(top, left, *size)))
    found = MotionOfCuts([Cut(3), *cuts])
    for picture in pictures[: max(cut.count for cut in cuts)]:
        found.add(Pyramid.of(picture))
    for cut, vectors in zip(cuts, found.vectors, strict=True):
        assert cut.cells is not None
        top, left, down, across = cut.cells
        np.testing.assert_array_equal(vectors, whole[: cut.count, :, top : top + down, left : left + across])
