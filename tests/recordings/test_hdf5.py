"""Test that HDF5 files which refer to other files are refused before those are read."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.trainer.evaluation.h5_file import random_recording
from trainer.evaluation.readers import Recording
from v2v_protocol.errors import UsageError
from v2v_recordings import mvsec
from v2v_recordings.hdf5 import require_self_contained


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return random_recording(tmp_path / "recording.h5")


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.h5"
    with h5py.File(path, "w") as file:
        file["numbers"] = np.arange(600.0)
    return path


def test_a_self_contained_file_is_read(recording: Path) -> None:
    with h5py.File(recording, "a") as file:
        file["events/again"] = file["/"]  # a group within itself
        file["soft"] = h5py.SoftLink("/events/ts")
    with Recording(recording) as opened:
        assert len(opened) == 600


def test_an_external_link_is_refused(recording: Path, secret: Path) -> None:
    with h5py.File(recording, "a") as file:
        del file["events/ts"]
        file["events/ts"] = h5py.ExternalLink(str(secret), "/numbers")
    with pytest.raises(UsageError, match=rf"/events/ts links to {secret}, and only data inside .* h5repack"):
        Recording(recording)


def test_external_storage_is_refused(recording: Path, secret: Path) -> None:
    with h5py.File(recording, "a") as file:
        file.create_dataset("more/deep", (8,), "u1", external=[(str(secret), 0, 8)])
    with pytest.raises(UsageError, match="/more/deep is a dataset with external storage"):
        Recording(recording)


def test_a_virtual_dataset_is_refused(recording: Path, secret: Path) -> None:
    layout = h5py.VirtualLayout((600,), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "numbers", (600,))
    with h5py.File(recording, "a") as file:
        file.create_virtual_dataset("copied", layout)
        with pytest.raises(UsageError, match="/copied is a virtual dataset"):
            require_self_contained(file, recording)


def test_a_recording_to_convert_is_checked_too(tmp_path: Path, secret: Path) -> None:
    path = tmp_path / "indoor_data.hdf5"
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = h5py.ExternalLink(str(secret), "/numbers")
    with pytest.raises(UsageError, match="/davis/left/events links to"):
        mvsec.recognises(path)
