"""Configuration: file and flags, refusals that name the flag, and no open port by accident."""

from __future__ import annotations

from collections.abc import Sequence
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.server.named_corpus import corpus, video
from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.spec import StreamSpec
from v2v_server.commands.serve import main
from v2v_server.config import DEFAULT_BIND, ServeConfig, read_yaml_mapping, recipe_setting
from v2v_server.serve import serve


def load(tmp_path: Path, text: str | None = None, settings: Sequence[str] = (), **flags: Any) -> ServeConfig:
    """The configuration from a YAML text, if any, settings of the recipe, and flags."""
    if text is None:
        return ServeConfig.load(None, flags, settings)
    file = tmp_path / "serve.yaml"
    file.write_text(text, encoding="utf-8")
    return ServeConfig.load(str(file), flags, settings)


# --- file and flags ---------------------------------------------------------------------------------------------------


def test_defaults(tmp_path: Path) -> None:
    config = load(tmp_path, videos="clips", workers=None)
    assert config == load(tmp_path, "", videos="clips") == ServeConfig(videos="clips")
    assert (config.workers, config.bind, config.insecure) == ((2, 2), DEFAULT_BIND, False)
    assert config.spec == StreamSpec()


def test_a_flag_wins_over_the_file_and_the_file_over_the_default(tmp_path: Path) -> None:
    config = load(tmp_path, "videos: a\nworkers: 5\nrows: top:0.54\nshuffle: false\n", workers=7, rows=None)
    assert (config.videos, config.workers, config.rows, config.spec.shuffle) == ("a", (7, 7), "top:0.54", False)
    assert config.max_credit_bytes == ServeConfig(videos="a").max_credit_bytes


def test_a_preset_as_flag_wins_over_what_the_file_says_of_its_fields(tmp_path: Path) -> None:
    text = "videos: a\nsamples_per_decode: 1\nmax_sequences_per_video: 3\n"
    spec = load(tmp_path, text, preset="fast").spec
    assert (spec.samples_per_decode, spec.max_sequences_per_video) == (4, 3)
    assert load(tmp_path, text, preset="fast", samples_per_decode=2).spec.samples_per_decode == 2
    spaced = "videos: a\nsamples_per_decode: 2\nsibling_spacing: 48\n"
    assert load(tmp_path, spaced, preset="natural").spec == StreamSpec.from_dict({"preset": "natural"})


def test_the_recipe_of_the_file_may_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text("preset: paper\nbins: 3\n")
    assert load(tmp_path, f"videos: a\nrecipe: {tmp_path}/camera.yaml\n").spec.recipe == Recipe(bins=3)
    assert load(tmp_path, "videos: a\nrecipe: clean\n").spec.recipe == preset("clean")


def test_the_spec_is_made_of_the_spec_settings(tmp_path: Path) -> None:
    text = """
videos: a
recipe: {preset: paper-flow, threshold: [0.1, 0.2]}
voxel_dtype: int16
shuffle: false
max_sequences_per_video: 3
on_bad_video: raise
"""
    recipe = preset("paper-flow").replace(threshold=(0.1, 0.2))
    assert load(tmp_path, text).spec == StreamSpec(recipe, "int16", False, 3, "raise")
    assert load(tmp_path, text, recipe="paper").spec.recipe == Recipe()


def test_keys_may_be_written_as_the_flags_are(tmp_path: Path) -> None:
    text = "videos: a\nworker-bind: 'tcp://127.0.0.1:5556'\nlease-deadline-seconds: 5\nvoxel_dtype: int16\n"
    config = load(tmp_path, text)
    assert (config.worker_bind, config.lease_deadline_seconds) == ("tcp://127.0.0.1:5556", 5)
    assert config.spec.voxel_dtype == "int16"
    with pytest.raises(UsageError, match="port_file appears twice, with dashes and with underscores"):
        load(tmp_path, "videos: a\nport-file: a\nport_file: b\n")
    with pytest.raises(UsageError, match=r"unknown key in --config .*: 'worker_bin' \(did you mean 'worker_bind'\?\)"):
        load(tmp_path, "videos: a\nworker-bin: a\n")


@pytest.mark.parametrize(
    ("flags", "recipe"),
    [
        ("", "clean gamma=1.5"),
        ("--set bins=3", "clean gamma=1.5 bins=3"),
        ("--set gamma=2 --set bins=3", "clean gamma=2 bins=3"),
        ("--recipe davis346", "davis346"),
        ("--recipe davis346 --set bins=3", "davis346 bins=3"),
        ("--preset natural-davis346", "davis346-running"),
        ("--preset natural-davis346 --set bins=3", "davis346-running bins=3"),
        ("--preset natural-davis346 --recipe clean", "clean"),
    ],
)
def test_single_fields_are_changed_in_the_recipe_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: str, recipe: str
) -> None:
    file = tmp_path / "serve.yaml"
    file.write_text("videos: a\nrecipe: {preset: clean, gamma: 1.5}\n")
    served: list[ServeConfig] = []
    monkeypatch.setattr("v2v_server.serve.serve", lambda config, *_: served.append(config))
    main(["--config", str(file), *flags.split()])
    name, *changes = recipe.split()
    assert served[0].spec.recipe == recipe_setting(name, changes)


def test_settings_change_the_recipe_of_a_stream_preset_in_the_file(tmp_path: Path) -> None:
    config = load(tmp_path, "videos: a\npreset: natural-davis346\n", ["bins=3"])
    assert config.spec.recipe == preset("davis346-running").replace(bins=3)
    assert config.spec.scene == "auto"


def test_a_named_recipe_of_the_file_is_changed_too_and_without_one_the_papers(tmp_path: Path) -> None:
    assert load(tmp_path, "videos: a\nrecipe: clean\n", ["bins=3"]).spec.recipe == preset("clean").replace(bins=3)
    assert load(tmp_path, None, ["bins=3"], videos="a").spec.recipe == Recipe(bins=3)
    with pytest.raises(RecipeError, match="unknown recipe 5"):
        load(tmp_path, "videos: a\nrecipe: 5\n", ["bins=3"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("worker: 3", r"unknown key in --config .*: 'worker' \(did you mean 'workers'\?\); known: videos, list"),
        ("spec: 1", "unknown key in .*: 'spec'"),
        ("zzz: 1", "unknown key in .*: 'zzz'; known"),
        ("- a", "expected keys and values, found list"),
        ("5: 6", "expected keys and values, found dict"),
        ("a: [", "--config .*: not YAML"),
        ("a: 2001-99-99", "--config .*: not YAML"),
        ("workers: 3\nworkers: 4", "--config .*: not YAML: 'workers' appears twice in .*, line 2"),
        ("recipe: {gamma: 2, bins: 3, gamma: 1}", "'gamma' appears twice"),
        ("[a]: 1", "not YAML: .* unhashable key"),
        ("workers: two", "--workers = 'two': give a whole number, or LEAST:MOST, from 0 to 4096"),
        ("workers: true", "--workers = True: give a whole number"),
        ("workers: 2.0", "--workers = 2.0"),
        ("workers: -1", "--workers = -1: give a whole number, or LEAST:MOST, from 0 to 4096"),
        ("workers: 4097", "--workers = 4097"),
        ("workers: '8:'", "--workers = '8:': give a whole number, or LEAST:MOST, from 0 to 4096"),
        ("workers: '1:2:3'", "--workers = '1:2:3': give a whole number"),
        ("workers: '-1:4'", "--workers = '-1:4': give a whole number"),
        ("workers: 8:5000", "--workers = '8:5000': give a whole number"),
        ("workers: [1.5, 2]", "--workers = .*: give a whole number"),
        ("workers: []", "--workers = .*: give a whole number"),
        ("workers: 8:4", "the lowest value comes first"),
        ("expect_workers: -1", "--expect-workers = -1: give a whole number from 0 to 4096"),
        ("expect-workers: 4097", "--expect-workers = 4097"),
        ("max_credit_bytes: 0", "--max-credit-bytes = 0"),
        ("max_credit_bytes: 1e9", "--max-credit-bytes = "),
        ("insecure: 1", "--insecure = 1: give true or false"),
        ("shuffle: 'no'", "shuffle = 'no'"),
        ("bind: 5555", "--bind = 5555: give text"),
        ("scene: off", "scene = False: choose one of off, auto .*off, on, no and yes .* in quotes"),
        ("list: [a]", r"--list = \['a'\]: give text"),
        ("rows: top", "rows 'top'"),
        ("rows: top:1.5", "rows 0:1.5"),
        ("lease_deadline_seconds: 0", "--lease-deadline-seconds = 0: give a number from 0.001 to 1e.06 s"),
        ("lease_deadline_seconds: .nan", "--lease-deadline-seconds = nan"),
        ("lease_deadline_seconds: .inf", "--lease-deadline-seconds = inf"),
        ("lease_deadline_seconds: true", "--lease-deadline-seconds = True"),
        ("scale_seconds: soon", "--scale-seconds = 'soon'"),
        ("scale_seconds: -1", "--scale-seconds = -1"),
        ("voxel_dtype: int32", "voxel_dtype = 'int32'"),
        ("on_bad_video: skip", "on_bad_video = 'skip'"),
        ("max_sequences_per_video: 0", "max_sequences_per_video = 0"),
        ("recipe: papr", r"unknown recipe 'papr' \(did you mean 'paper'\?\)"),
        ("recipe: {self: 1}", "unknown recipe key 'self'"),
        ("recipe: {1: 2}", "unknown recipe key '1'"),
        ("recipe: {threshold: [1]}", r"recipe threshold = \[1\]"),
        ("videos: ''", "--videos is missing"),
        ("videos: 7", "--videos = 7"),
    ],
)
def test_refusals_name_the_flag(tmp_path: Path, text: str, message: str) -> None:
    flags = {} if text.startswith("videos") else {"videos": "a"}
    with pytest.raises(UsageError, match=message):
        load(tmp_path, text, **flags)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--config .*: No such file"):
        read_yaml_mapping("--config", str(tmp_path / "none.yaml"))
    with pytest.raises(UsageError, match=r"--config .*: Is a directory"):
        read_yaml_mapping("--config", str(tmp_path))
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9")
    with pytest.raises(UsageError, match=r"--recipe .*: not YAML"):
        read_yaml_mapping("--recipe", str(tmp_path / "latin.yaml"))
    with pytest.raises(UsageError, match="--config"):
        read_yaml_mapping("--config", "a\0b")


# --- addresses --------------------------------------------------------------------------------------------------------

PRIVATE = [
    "tcp://127.0.0.1:5555",
    "tcp://127.0.0.1:*",
    "tcp://127.0.0.1:0",
    "tcp://127.1.2.3:1",
    "tcp://localhost:65535",
    "tcp://[::1]:5555",
    "tcp://[::1]:*",
    "ipc:///tmp/socket",
    "ipc://@abstract",
]
REACHABLE = [
    "tcp://0.0.0.0:5555",
    "tcp://*:5555",
    "tcp://*:*",
    "tcp://[::]:5555",
    "tcp://[::ffff:0.0.0.0]:5555",
    "tcp://192.168.1.7:5555",
    "tcp://8.8.8.8:5555",
    "tcp://eth0:5555",
    "tcp://lo:5555",
    "tcp://example.org:5555",
    "tcp://localhost.example.org:5555",
    "tcp://127.0.0.1.example.org:5555",
    "tcp://127.0.0.1@0.0.0.0:5555",
    "tcp://127.0.0.1#@0.0.0.0:5555",
    "tcp://127.0.0.1;0.0.0.0:5555",
    "tcp://0:5555",
    "tcp://0177.0.0.1:5555",
    "tcp://127.1:5555",
    "tcp://::1:5555:5555",
    "tcp://[127.0.0.1:5555",
    "tcp://[::1:5555",
    "tcp://[fe80::1%lo]:5555",
]
MALFORMED = [
    "127.0.0.1:5555",
    "tcp://",
    "tcp://127.0.0.1",
    "tcp://:5555",
    "tcp://127.0.0.1:",
    "tcp://127.0.0.1:65536",
    "tcp://127.0.0.1:-1",
    "tcp://127.0.0.1:5555/",
    "tcp://127.0.0.1:\u00b2",
    "tcp://127.0.0.1:\u0665",
    "tcp://127.0.0.1:55 55",
    "tcp://[::1]",
    "http://127.0.0.1:80",
    "inproc://x",
    "ipc://",
    "5555",
]


@pytest.mark.parametrize("flag", ["bind", "worker_bind"])
@pytest.mark.parametrize("address", PRIVATE)
def test_this_host_needs_no_word(flag: str, address: str) -> None:
    assert getattr(ServeConfig.load(None, {"videos": "a", flag: address}), flag) == address


@pytest.mark.parametrize("flag", ["bind", "worker_bind"])
@pytest.mark.parametrize("address", REACHABLE)
def test_addresses_for_other_hosts_need_keys_or_insecure(flag: str, address: str) -> None:
    with pytest.raises(UsageError, match=rf"--{flag.replace('_', '-')} .*--insecure"):
        ServeConfig.load(None, {"videos": "a", flag: address})
    assert getattr(ServeConfig.load(None, {"videos": "a", flag: address, "insecure": True}), flag) == address


@pytest.mark.parametrize("insecure", [True, False])
@pytest.mark.parametrize("address", MALFORMED)
def test_what_is_no_address(address: str, insecure: bool) -> None:
    with pytest.raises(UsageError, match=r"--bind .*: write tcp://HOST:PORT"):
        ServeConfig.load(None, {"videos": "a", "bind": address, "insecure": insecure})


@given(st.text(max_size=20) | st.text(alphabet="[]:*@/.0127%#;", max_size=16))
def test_any_text_is_an_address_or_a_refusal(text: str) -> None:
    for address in (text, f"tcp://{text}", f"tcp://{text}:5555", f"tcp://127.0.0.1:{text}"):
        try:
            ServeConfig(videos="a", bind=address)
        except UsageError:
            continue
        assert address.startswith(("tcp://localhost:", "ipc://")) or _is_loopback(address), address


def _is_loopback(address: str) -> bool:
    """However it is written: 0::1 is ::1."""
    host = address.removeprefix("tcp://").rpartition(":")[0]
    return ip_address(host.removeprefix("[").removesuffix("]")).is_loopback


def test_an_empty_worker_address_is_a_private_one_and_an_empty_bind_is_none() -> None:
    assert ServeConfig(videos="a", worker_bind="").worker_bind == ""
    with pytest.raises(UsageError, match="--bind ''"):
        ServeConfig(videos="a", bind="")


# --- --recipe and --set -----------------------------------------------------------------------------------------------


def test_settings_change_the_named_preset(tmp_path: Path) -> None:
    assert recipe_setting("paper-eraft", []) == preset("paper-eraft")
    assert recipe_setting(None, ["bins=3"]) == Recipe(bins=3)
    asked = recipe_setting(
        "paper-flow", ["threshold=[0.2, 0.5]", " gamma = 2 ", "noise_scales_with_threshold=true", "noise_unit=second"]
    )
    assert asked == preset("paper-flow").replace(
        threshold=(0.2, 0.5), gamma=2.0, noise_scales_with_threshold=True, noise_unit="second"
    )
    # 1e-3 is text in YAML 1.1.
    assert recipe_setting(None, ["refractory_seconds=[1e-4, 1e-3]"]) == Recipe(refractory_seconds=(1e-4, 1e-3))
    file = tmp_path / "recipe.yaml"
    file.write_text("preset: paper-eraft\nbins: 3\n", encoding="utf-8")
    assert recipe_setting(str(file), ["bins=4"]) == preset("paper-eraft").replace(bins=4)
    assert StreamSpec.from_dict({"recipe": recipe_setting(str(file), [])}).recipe.bins == 3


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("bins", "--set bins: write KEY=VALUE"),
        ("", "--set : write KEY=VALUE"),
        ("bins=[", r"--set bins=\[: '\[' is not a value"),
        ("gamma=2001-99-99", "is not a value"),
        ("bin=3", "unknown recipe key 'bin'"),
        ("self=3", "unknown recipe key 'self'"),
        ("=3", "unknown recipe key ''"),
        ("bins=", "recipe bins = None"),
        ("bins=3.5", "recipe bins = 3.5"),
        ("bins=yes", "recipe bins = True"),
        ("gamma=.nan", "recipe gamma = nan"),
        ("threshold=0.2,0.5", r"threshold = '0.2,0.5': give one number, or a pair \[lowest, highest\]"),
        ("preset=papr", "unknown recipe"),
    ],
)
def test_settings_that_make_no_sense(setting: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        recipe_setting(None, [setting])


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("3", (3, 3)),
        ("'3'", (3, 3)),
        ("8:32", (8, 32)),  # in YAML 1.1 a number of base 60
        ("[0, 4]", (0, 4)),
    ],
)
def test_workers_are_a_number_or_two(tmp_path: Path, said: str, meant: tuple[int, int]) -> None:
    config = load(tmp_path, f"videos: a\nworkers: {said}\n")
    assert (config.least_workers, config.most_workers) == config.workers == meant


@pytest.mark.parametrize(
    ("workers", "expected"),
    [
        ({}, 2),
        ({"workers": 0, "expect_workers": 64, "worker_bind": "tcp://127.0.0.1:*"}, 64),
        ({"workers": 9, "expect_workers": 5}, 9),
    ],
)
def test_the_workers_that_a_credit_is_settled_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, workers: dict[str, int], expected: int
) -> None:
    class Stopped(Exception):
        pass

    def broker(*given: Any, expected_workers: int, **settings: Any) -> None:
        raise Stopped(expected_workers)

    for what_changes_this_process in ("keep_freed_memory", "open_many_files"):
        monkeypatch.setattr(f"v2v_server.serve.{what_changes_this_process}", lambda: None)
    monkeypatch.setattr("v2v_server.serve.load_catalogue", lambda config: corpus(video("a.mp4")))
    monkeypatch.setattr("v2v_server.serve.Broker", broker)
    monkeypatch.setattr("v2v_server.serve.notes_of", lambda catalogue: [])  # these videos are no columns
    small = ["voxels_per_clip=1", "crop_height_px=8", "crop_width_px=8"]
    with pytest.raises(Stopped, match=f"^{expected}$"):
        serve(load(tmp_path, None, small, videos="a", bind="tcp://127.0.0.1:*", **workers))
