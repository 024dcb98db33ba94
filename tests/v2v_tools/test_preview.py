"""`v2v-preview`: every kind of file, recipes side by side, videos too short or too small, and what is refused."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image as Pictures

from tests.clips import panned_luma, write_clip
from tests.oracles.rendered import rendered_scene
from v2v_pictures.sheet import class_colour
from v2v_protocol.errors import CorpusError, UsageError
from v2v_tools import preview as command
from v2v_tools.preview import PreviewCamera, preview

TINY = {"voxels_per_clip": 2, "bins": 2, "crop_height_px": 48, "crop_width_px": 64}


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "gliding.mp4", panned_luma(40, 96, 128))


def test_each_kind_of_file_is_what_its_name_says_and_progress_is_shown(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("v2v_protocol.progress.LOG_SECONDS", 0.0)
    three = [PreviewCamera(str(seed), TINY, seed) for seed in range(3)]
    for kind, wanted in (("png", three[:2]), ("gif", three[:1]), ("html", three[:1]), ("mp4", three)):
        capsys.readouterr()
        preview(
            str(clip), tmp_path / f"preview.{kind}", wanted, {}, title="t", cache_dir=str(tmp_path),
            with_flow=kind == "png", say=lambda line: None,
        )  # fmt: skip
    with Pictures.open(tmp_path / "preview.png") as picture:
        assert picture.format == "PNG"
    with Pictures.open(tmp_path / "preview.gif") as picture:
        assert picture.n_frames == 2
    with av.open(io.BytesIO((tmp_path / "preview.mp4").read_bytes())) as film:
        assert len(list(film.decode(video=0))) == 2 * 2
    assert "data:image/png;base64," in (tmp_path / "preview.html").read_text()
    said = capsys.readouterr().err.splitlines()
    cameras = [line for line in said if line.startswith("simulating: ")]
    assert [line.split(" cameras")[0] for line in cameras] == [f"simulating: {number} of 3" for number in range(1, 4)]
    assert re.search("a second.* left", cameras[1])
    assert sum(line.startswith("drawing the film: ") for line in said) == 2 * 2


def test_a_single_video_is_shown_with_the_boxes_beside_it(clip: Path, tmp_path: Path) -> None:
    (tmp_path / clip.name).symlink_to(clip)
    boxes = tmp_path / f"{clip.stem}.boxes.txt"
    pages = []
    for text in ("", "".join(f"{frame},1,33,25,61,50,1,-1,-1,-1\n" for frame in range(1, 41))):
        if text:
            boxes.write_text(text)
        out = tmp_path / "p.png"
        preview(
            str(tmp_path / clip.name), out, [PreviewCamera("", TINY, 0)], {}, title="t", cache_dir=str(tmp_path),
            with_flow=False, say=lambda line: None,
        )  # fmt: skip
        with Pictures.open(out) as picture:
            pages.append(np.asarray(picture.convert("RGB")))
    plain, labelled = ((page == class_colour(0)).all(axis=-1).sum() for page in pages)
    assert plain == 0
    assert labelled > 2 * (61 + 50)


def test_a_video_too_short_or_too_small_is_shown_all_the_same_and_said(clip: Path, tmp_path: Path) -> None:
    said: list[str] = []
    wanted = [PreviewCamera("paper", "paper", 0)]
    preview(str(clip), tmp_path / "p.png", wanted, {}, title="t", cache_dir=str(tmp_path), say=said.append)
    # 40 frames: 7 grids of 5 bins; 96 rows: a crop of 128 shrinks by quarters.
    assert "all cameras: shown with 7 voxel grids of 96 x 96 instead of 40 of 128 x 128" in said[0]
    assert said[-1] == f"{tmp_path / 'p.png'}: 1 camera"


def test_what_a_server_says_of_a_video_is_said(tmp_path: Path) -> None:
    write_clip(tmp_path / "fields.mp4", panned_luma(60, 64, 64), options={"x264-params": "interlaced=1"})
    recipe = {"crop_height_px": 48, "crop_width_px": 48, "voxels_per_clip": 4}
    said: list[str] = []
    preview(
        str(tmp_path / "fields.mp4"), tmp_path / "a.png", [PreviewCamera("", recipe, 0)], {}, title="", say=said.append
    )
    assert said[0].startswith("1 video is interlaced (fields.mp4): the frames are served as they are stored")


def test_a_video_of_one_frame_is_refused(tmp_path: Path) -> None:
    still = write_clip(tmp_path / "still.mp4", panned_luma(1, 64, 64))
    with pytest.raises(CorpusError, match=r"still\.mp4"):
        preview(str(still), tmp_path / "p.png", [PreviewCamera("", "paper", 0)], {}, title="t", cache_dir=str(tmp_path))
    assert not (tmp_path / "p.png").exists()


def test_the_command_compares_recipes_on_one_clip(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[tuple[str, int]] = []
    drawn = command.preview

    def spy(source: str, out: Path, wanted: list[PreviewCamera], *rest: object, **named: object) -> None:
        seen.extend((each.title, each.seed) for each in wanted)
        drawn(source, out, wanted, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(command, "preview", spy)
    sets = [f"--set={name}={value}" for name, value in TINY.items()]
    own = tmp_path / "own.yaml"
    own.write_text("preset: paper\nthreshold: [0.3, 0.3]\n")
    out = tmp_path / "c.png"
    command.main(
        [
            str(clip),
            "--out",
            str(out),
            "--compare",
            "paper",
            "noise-free",
            str(own),
            *sets,
            "--cache-dir",
            str(tmp_path),
        ]
    )
    assert seen == [("paper", 0), ("noise-free", 0), ("own", 0)]
    assert np.asarray(Pictures.open(out)).ndim == 3
    chosen, started, _, said = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"the start of a clip makes \d+% of its events without noise \(recipe field start\)", started)
    assert re.fullmatch(r"seed \d+: chosen because their crops show motion; --seed 0 takes what chance gives", chosen)
    assert said == f"{out}: 3 cameras"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--out", "p.bmp"], "--out p.bmp: unknown ending; give a name that ends in .png, .mp4, .gif, .html"),
        (["--out", "p.png", "--seeds", "0"], "--seeds 0: give 1 to 32"),
        (["--out", "p.png", "--moments", "99"], "--moments 99: give 1 to 32"),
        (["--out", "nowhere/p.png"], "--out nowhere/p.png: there is no folder nowhere"),
        (["--out", "p.png", "--recipe", "paper", "--compare", "paper"], "leave --recipe out"),
        (["--out", "p.png", "--seeds", "2", "--compare", "paper"], "leave --seeds out"),
        (["--out", "p.png", "--recipe", "papr"], "paper"),
    ],
)
def test_what_is_wrong_is_one_line_and_leaves_no_file(
    flags: list[str],
    said: str,
    clip: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command.main([str(clip), *flags]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_recipes_of_other_sizes_are_not_compared(clip: Path, tmp_path: Path) -> None:
    """A sheet needs equal bins, a film also equal clips."""
    more: dict[str, Any] = {"title": "t", "with_flow": False, "cache_dir": str(tmp_path / "cache")}
    bins = [PreviewCamera(f"b{number}", {**TINY, "bins": number}, 0) for number in (2, 3)]
    clips = [PreviewCamera(f"c{number}", {**TINY, "voxels_per_clip": number}, 0) for number in (2, 3)]
    with pytest.raises(UsageError, match=r"b2 has 2 frames of 2 bins here, b3 has 2 .*: give recipes of equal bins"):
        preview(str(clip), tmp_path / "p.png", bins, {}, **more)
    with pytest.raises(UsageError, match=r"c2 has 2 frames of 2 bins here, c3 has 3 "):
        preview(str(clip), tmp_path / "p.gif", clips, {}, **more)
    assert not list(tmp_path.glob("p.*"))
    preview(str(clip), tmp_path / "p.png", clips, {}, **more)
    assert (tmp_path / "p.png").exists()


def _said(source: Path, tmp_path: Path) -> str:
    said: list[str] = []
    wanted = [
        PreviewCamera("a", {"preset": "noise-free", "voxels_per_clip": 3, "crop_height_px": 64, "crop_width_px": 64}, 0)
    ]
    preview(str(source), tmp_path / "a.png", wanted, {}, title="t", cache_dir=str(tmp_path), say=said.append)
    return said[-2]


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ("pan", r"motion: [4-7][\d.]* px a frame .*turns back .* v2v-tradeoff --videos DIR .* tells the error .*"),
        ("noise", r"motion: .* no block follows \d\d%; something small or fast moves, .*sub-steps do not help"),
        ("still", r"motion: 0 px a frame .* no block follows 0%"),
    ],
)
def test_a_preview_says_what_moves(scene: str, said: str, tmp_path: Path) -> None:
    moving = rendered_scene("coffee", 96, 96, 180.0).frames(30.0, 20)
    noise = np.random.default_rng(1).integers(0, 256, moving.shape, np.uint8)
    frames = {"pan": moving, "noise": noise, "still": moving[:1].repeat(20, axis=0)}[scene]
    line = _said(write_clip(tmp_path / "clip.mp4", frames), tmp_path)
    assert re.fullmatch(said, line), line
