"""What a server says of its pictures without being asked."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.scenes import picture_check
from v2v_server.corpus.scenes.picture_check import check_in_background


@pytest.mark.parametrize("ends_first", [False, True])
def test_a_server_says_once_which_share_of_its_sequences_has_defects(
    ends_first: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_check, "_SERVER_WAITS_SECONDS", 0.0)
    moving = panned_luma(60, 96, 128)
    for name, luma in {"clean": moving, "twos": moving[np.arange(60) // 2]}.items():
        write_clip(tmp_path / f"{name}.mkv", luma, codec="ffv1", pixel_format="gray", full_range=True)
    spec = StreamSpec(recipe=Recipe(voxels_per_clip=1, bins=29, crop_height_px=32, crop_width_px=32))
    said, stop = list[str](), threading.Event()
    with closing(open_catalogue(tmp_path, cache_dir=tmp_path / "index", processes=0)) as catalogue:
        if ends_first:
            stop.set()
        thread = check_in_background(catalogue, spec, stop, said.append, processes=0)
        assert thread is not None
        thread.join(60)
        assert not thread.is_alive()
    expected = (
        "pictures: of 4 sequences of 2 videos, 50% have duplicated frames: --scene auto leaves these out; "
        "v2v-doctor --videos names the videos"
    )
    assert said == ([] if ends_first else [expected])
