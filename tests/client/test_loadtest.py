"""Test the load test, and its check of the samples against the schedule."""

from __future__ import annotations

import json
import os

import pytest

from tests.client.fake_server import FakeServer
from v2v_client import loadtest
from v2v_client.loadtest import ScheduleCheck
from v2v_client.local_server import server_flags
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec_flags import recipe_changes

KEYS = {
    "workers", "batches_per_second", "samples_per_second", "p50_ms", "p99_ms", "cpu_seconds_per_batch",
    "bytes_per_second", "client_stall_fraction", "peak_rss_bytes", "lost", "duplicated", "accelerator_utilisation",
    "samples_per_decode", "batches", "seconds", "warmup_batches", "batch_size", "epochs", "address",
}  # fmt: skip


@pytest.fixture
def server():
    with FakeServer(sequences=9, credit=8) as running:
        yield running


def run(server, tmp_path, *flags):
    file = tmp_path / "out.json"
    arguments = ["--connect", server.address, "--batch-size", "4", "--seconds", "0.2", "--json", str(file), *flags]
    return loadtest.main(arguments), file


def test_a_run_over_several_epochs_is_measured_without_faults(server, tmp_path, capsys):
    status, file = run(server, tmp_path, "--warmup-batches", "3", "--trainer-ms", "1", "--arrays", "voxels")
    assert status == 0
    (record,) = json.loads(file.read_text())
    assert record.keys() >= KEYS
    assert (record["lost"], record["duplicated"], record["warmup_batches"], record["batch_size"]) == (0, 0, 3, 4)
    assert record["epochs"] == (record["batches"] + 3 - 1) // 2
    assert record["bytes_per_second"] == pytest.approx(record["samples_per_second"] * 2 * 2 * 4 * 6)
    assert 0 < record["client_stall_fraction"] < 1
    assert record["accelerator_utilisation"] == pytest.approx(record["batches"] * 1e-3 / record["seconds"])
    assert record["cpu_seconds_per_batch"] >= 4 * 0.25  # what the fake states for each sample
    text = capsys.readouterr().out
    assert "3 warm-up batches not timed" in text
    assert "batch/s" in text


def test_skipped_batches_are_detected(server, tmp_path, monkeypatch):
    class Skipping(loadtest.V2VStreamDataset):
        def __iter__(self):
            return (batch for number, batch in enumerate(super().__iter__()) if number != 0)

    monkeypatch.setattr(loadtest, "V2VStreamDataset", Skipping)
    status, file = run(server, tmp_path)
    assert status == 1
    assert json.loads(file.read_text())[0]["lost"] > 0


def test_an_interrupt_ends_the_measurement_and_keeps_its_results(server, tmp_path, monkeypatch, capsys):
    class Interrupted(loadtest.V2VStreamDataset):
        def __iter__(self):
            for batch in super().__iter__():
                if taken:
                    raise KeyboardInterrupt
                taken.append(batch.indices)
                yield batch

    taken = []
    monkeypatch.setattr(loadtest, "V2VStreamDataset", Interrupted)
    status, file = run(server, tmp_path, "--seconds", "60", "--warmup-batches", "0")
    assert status == 130
    (record,) = json.loads(file.read_text())
    assert (record["batches"], record["interrupted"]) == (1, True)
    shown = capsys.readouterr()
    assert "batch/s" in shown.out
    assert "of 60 s" in shown.err


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--set", "gama=1"], "gama"),
        (["--set", "gamma"], "KEY=VALUE"),
        (["--arrays", "pixels"], "pixels"),
        (["--seconds", "0"], "--seconds"),
        (["--trainer-ms", "nan"], "--trainer-ms nan"),
        (["--workers", "2"], "--workers"),
        (["--json", "/nowhere/out.json"], "/nowhere/out.json"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(server, tmp_path, capsys, flags, word):
    status, _ = run(server, tmp_path, *flags)
    assert status == 2
    error = capsys.readouterr().err
    assert word in error
    assert error.count("\n") == 1


def test_a_local_server_gets_the_requested_recipe(server, monkeypatch):
    started = []

    class Local:
        pid = os.getpid()

        def __init__(self, videos, *, workers, flags):
            self.address = server.address
            started.append((videos, workers, flags))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def cpu_seconds(self):
            return {}

        rss_bytes = cpu_seconds

    monkeypatch.setattr(loadtest, "LocalServer", Local)
    flags = ["--videos", "clips", "--workers", "3", "--batch-size", "4", "--seconds", "0.1", "--rows", "top:0.5"]
    # With its own, the paper's 201 frames, it would refuse clips that are long enough for this.
    assert loadtest.main([*flags, "--recipe", "clean", "--set", "bins=3", "--set", "gamma=2"]) == 0
    rows, asked = ("--rows", "top:0.5"), Recipe.from_dict({"preset": "clean", "bins": 3, "gamma": 2})
    loadtest.main([*flags, "--preset", "natural"])
    assert started == [
        ("clips", 3, server_flags(asked, {}, *rows)),
        ("clips", 3, server_flags(Recipe(), {"preset": "natural"}, *rows)),
    ]
    assert "gamma=2.0" in started[0][2]
    assert started[1][2][-4:] == ["--scene", "auto", *rows]


def test_no_server_is_status_2(capsys, unused_port):
    arguments = ["--connect", f"tcp://127.0.0.1:{unused_port}", "--timeout-seconds", "0.2"]
    assert loadtest.main(arguments) == 2
    assert "nothing received" in capsys.readouterr().err


def test_changes_to_the_recipe_are_yaml():
    assert recipe_changes(None, []) is None
    assert recipe_changes("paper", []) == {"preset": "paper"}
    assert recipe_changes("paper", ["threshold=[0.1, 0.5]", "bins=3"]) == {
        "preset": "paper",
        "threshold": [0.1, 0.5],
        "bins": 3,
    }
    for change in ("bins={", "gamma=2001-99-99"):
        with pytest.raises(UsageError, match="not a value"):
            recipe_changes(None, [change])


@pytest.mark.parametrize(("share", "value"), [(0.5, 50), (0.99, 99), (0.0, 1), (1.0, 100), (0.001, 1)])
def test_percentiles_are_nearest_rank(share, value):
    assert loadtest.percentile(list(range(100, 0, -1)), share) == value


def epochs(*wanted, sequences=11, batch=2):
    return [(epoch, [at, at + 1]) for epoch in wanted for at in range(0, sequences - sequences % batch, batch)]


def checked(batches, first_epoch=3):
    check = ScheduleCheck(sequences=11, batch_size=2, first_epoch=first_epoch)
    for epoch, indices in batches:
        check.observe(epoch, indices)
    return check


def counts(check):
    return check.lost, check.duplicated, check.foreign, check.out_of_order


def test_a_correct_run_over_epochs_has_no_faults():
    check = checked(epochs(3, 4)[:-2])
    assert counts(check) == (0, 0, 0, 0)
    assert check.faultless


PLANTED = {
    "a batch lost": (epochs(3)[:2] + epochs(3)[3:], (2, 0, 0, 1)),
    "a sample lost at the end of an epoch": ([*epochs(3)[:-1], (3, [8]), *epochs(4)], (1, 0, 0, 1)),
    "an epoch lost": (epochs(3) + epochs(5), (10, 0, 0, 1)),
    "the first batch lost": (epochs(3)[1:], (2, 0, 0, 1)),
    "a batch twice": ([*epochs(3), epochs(3)[-1]], (0, 2, 0, 1)),
    "a sample twice within a batch": ([(3, [0, 0])], (0, 1, 0, 1)),
    "an epoch twice": (epochs(3, 3), (0, 10, 0, 1)),
    "two batches exchanged": ([epochs(3)[1], epochs(3)[0], *epochs(3)[2:]], (0, 0, 0, 3)),
    "a sample of the dropped rest": ([*epochs(3), (3, [10])], (0, 0, 1, 0)),
    "a sample of an earlier epoch": ([(2, [0]), *epochs(3)], (0, 0, 1, 0)),
}


@pytest.mark.parametrize(("batches", "found"), PLANTED.values(), ids=PLANTED.keys())
def test_planted_faults_are_counted(batches, found):
    check = checked(batches)
    assert counts(check) == found
    assert not check.faultless
