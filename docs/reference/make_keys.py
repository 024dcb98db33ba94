# ruff: noqa: E501 - a line of Markdown is not wrapped by hand
"""Writes keys.md, the reference of all keys, from the statements of the fields: python docs/reference/make_keys.py"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from v2v_protocol.presets import PRESET_FIELDS
from v2v_protocol.recipe import EFFECTS, Recipe
from v2v_protocol.settings import Setting, settings_of
from v2v_protocol.spec import SPEED_PRESETS, StreamSpec
from v2v_server.config import ServeConfig

HEAD = """# All keys

Made by `python docs/reference/make_keys.py` from the one statement that each field has in the source; a test keeps it fresh.

Where a key can be written:

| key of | flag | YAML | Python |
|---|---|---|---|
| [server](#server) | `v2v-serve --lease-deadline-seconds 60` | `v2v-serve --config FILE`: `lease_deadline_seconds: 60` | |
| [stream](#stream) | `v2v-serve` and `v2v-simulate`: `--voxel-dtype int16` | the same file: `voxel_dtype: int16`; `v2v-train`: under `stream.spec` | `V2VStreamDataset(..., voxel_dtype="int16")` |
| [recipe](#recipe) | `--recipe paper --set bins=3` | `recipe: {preset: paper, bins: 3}`, or a file for `--recipe` | `V2VStreamDataset(..., recipe={"bins": 3})` |

What a consumer asks for wins over what the server has as its default. A range is drawn from uniformly, afresh for each sample; one number fixes the value.
"""

_SHIPPED, _FLOW, _OURS = "V2V's released training configurations", "V2V's flow networks", "this project"
SOURCES = dict.fromkeys(
    (
        "voxels_per_clip", "bins", "frames_per_bin", "crop_height_px", "crop_width_px", "resize_scale",
        "flip_probability", "pause_probability", "pause_stay_probability", "threshold", "threshold_ratio",
        "noise_sigma", "hot_pixel_share", "hot_pixel_sigma",
    ),
    _SHIPPED,
) | {
    "lead_frames": _FLOW,
    "lead_voxels": _FLOW,
    "contrast_probability": "V2V's ablation LDR, there 0.8",
    "contrast_scale": "V2V's ablation LDR",
    "gamma": "V2V's released code",
    "log_eps": "V2V's released code",
    "threshold_source": "V2V's ablation with fixed thresholds",
    "noise_scales_with_threshold": "an option of V2V's released code",
    "frame_stride": _OURS,
    "noise_unit": _OURS,
}  # fmt: skip
"""Where a recipe's field and its default come from; those of the effects are on a page of their own."""


def page() -> str:
    """The whole page."""
    return "\n".join([
        HEAD,
        *_section("Server", ServeConfig, flags=True),
        *_section("Stream", StreamSpec, flags=True),
        "### Speed presets: `preset`\n",
        *_presets(SPEED_PRESETS),
        *_section("Recipe", Recipe, flags=False),
        "### Recipe presets: `preset`\n",
        *_presets(PRESET_FIELDS),
    ])  # fmt: skip


def _section(title: str, cls: type[Any], *, flags: bool) -> Iterator[str]:
    yield f"## {title}\n"
    shown = [(name, setting) for name, setting in settings_of(cls).items() if not setting.is_hidden]
    for group, rows in groupby(shown, key=lambda row: row[1].group):
        if group != title:
            yield f"### {group}\n"
        sourced = cls is Recipe
        yield "| key | default | allowed | what it is |" + (" source |" if sourced else "")
        yield "|---|---|---|---|" + ("---|" if sourced else "")
        for name, setting in rows:
            yield _row(name, setting) + (f" {_source(name, group)} |" if sourced else "")
        yield ""


def _source(name: str, group: str) -> str:
    return "[effects](../effects.md#equations-and-sources)" if group == EFFECTS else SOURCES[name]


def _row(name: str, setting: Setting) -> str:
    allowed = setting.expected.removeprefix("give ").removeprefix("choose ")
    return f"| `{name}` | {_value(setting.default)} | {allowed} | {setting.help} |".replace(" |  |", " | |")


def _value(value: Any) -> str:
    if value == "":
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple) and value[0] == value[1] and isinstance(value[0], int):
        return f"`{value[0]}`"
    if isinstance(value, tuple):
        return f"`[{value[0]:g}, {value[1]:g}]`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _presets(presets: Any) -> Iterator[str]:
    yield "| preset | what it sets |\n|---|---|"
    for name, fields in presets.items():
        yield f"| `{name}` | {', '.join(f'{key} {_value(value)}' for key, value in fields.items()) or 'the defaults'} |"
    yield ""


if __name__ == "__main__":
    Path(__file__).with_name("keys.md").write_text(page(), encoding="utf-8")
