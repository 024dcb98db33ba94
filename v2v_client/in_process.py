"""Make samples of a stream by index in the calling process, without a server.

This is the only module of the client that uses the server's code. It imports that code when a dataset is created, and
needs the extra ``server``; no other module of the client does.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset
from torch.utils.data._utils.collate import default_collate_fn_map

from v2v_client.batch import Batch, Drawn, draw_samples, refuse
from v2v_client.options import Fixed, Labels, check_labels, require_arguments, require_labels, require_videos
from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.programs import counted, name_extra
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import DEFAULT_ARRAYS, LARGEST_EPOCH, LARGEST_SEED, Sample, html_table
from v2v_protocol.settings import as_whole, format_value, require_whole
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import read_recipe


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ShownSample(Drawn, Sample):
    """Hold a sample that a notebook can display. Each array is an attribute and an item, as of a batch.

    Attributes:
        recipe: needed to mark pauses, which are runs of repeated frames.
        title: title of its picture.
    """

    recipe: Recipe
    title: str

    def _picture(self) -> npt.NDArray[np.uint8]:
        return draw_samples([(self.arrays, self.provenance)], self.recipe, self.title)

    def _repr_html_(self) -> str:
        return Sample._repr_html_(self) + self._html_image()


ShownSample.__setattr__ = refuse  # type: ignore[method-assign]


class V2VDataset(Fixed, Dataset[Sample]):
    """Give indexed access to one epoch of a stream: ``dataset[i]`` equals the sample that a server streams at index i.

        dataset = V2VDataset("my-videos/", recipe="paper")
        dataset[0].arrays["voxels"]  # int8 [T, bins, H, W]
        for batch in DataLoader(dataset, batch_size=12, num_workers=4):
            batch.voxels  # a Batch, as from V2VStreamDataset, but with an empty resume_state

    Use it for inspection, tests and small experiments. It decodes in the calling process, so it is as slow as decoding;
    for training use :class:`v2v_client.V2VStreamDataset`.

    Args:
        videos: folder tree of videos, a single video, or a list file.
        recipe: the virtual cameras: name of a recipe, a mapping of fields, or a Recipe.
        arrays: names in ``v2v_protocol.sample.ARRAYS`` to make.
        seed: the stream's seed, which determines all draws and the order.
        epoch: the stream's epoch, which selects other cameras and another order.
        rows: rows of each picture to use, as for ``v2v-serve --rows``.
        list_file: list file that restricts a folder.
        cache_dir: folder of the catalogue's index; None uses the user's cache.
        videos_kind, rate, photograph_seconds, picture_bits, marks: what a video is, as for ``v2v-serve --videos-kind``.
        labels: see :class:`v2v_client.V2VStreamDataset`.
        options: ``preset`` and other fields of :class:`v2v_protocol.spec.StreamSpec`.

    Raises:
        UsageError: an argument is outside its range, or the extra ``server`` is not installed.
        CorpusError: no video can be used, or no video is long enough for a sequence.
    """

    def __init__(
        self,
        videos: str | os.PathLike[str],
        recipe: str | Mapping[str, Any] | Recipe | None = None,
        arrays: Sequence[str] = DEFAULT_ARRAYS,
        seed: int = 0,
        epoch: int = 0,
        rows: str = "full",
        list_file: str | None = None,
        cache_dir: str | None = None,
        videos_kind: str = "videos",
        rate: float = 0.0,
        photograph_seconds: float = 0.0,
        picture_bits: int = 0,
        marks: str = "pictures",
        labels: Labels = "required",
        **options: Any,
    ) -> None:
        require_arguments(V2VDataset.__init__, options)
        self._seed = require_whole("seed", seed, 0, LARGEST_SEED)
        self._epoch = require_whole("epoch", epoch, 0, LARGEST_EPOCH)
        self._needs_labels = check_labels(labels)
        self.spec = StreamSpec.from_dict({**options, "recipe": read_recipe(recipe)})
        self.spec.recipe.warn()
        self._arrays = (arrays,) if isinstance(arrays, str) else tuple(arrays)
        self._videos = require_videos(videos)
        self._kind = {
            "videos_kind": videos_kind, "rate": rate, "photograph_seconds": photograph_seconds,
            "picture_bits": picture_bits, "marks": marks,
        }  # fmt: skip
        self._source = {"rows": rows, "list_file": list_file, "cache_dir": cache_dir}
        self._maker: Any = None
        self._process = 0
        self._length = int(self._open().count)

    @property
    def seed(self) -> int:
        """Return the seed of the draws and of the order."""
        return self._seed

    @property
    def epoch(self) -> int:
        """Return the epoch of the samples."""
        return self._epoch

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> ShownSample:
        """Make the sample at ``index``; negative indices count from the end.

        Raises:
            IndexError: ``index`` is outside -len .. len - 1.
            UsageError: it is not a whole number.
            SampleUnavailable: no candidate video could give it, or it lacks its labels.
        """
        place = self._place(index)
        sample: Sample = self._open().sample(self.seed, self.epoch, place)
        if self._needs_labels:
            require_labels([sample.provenance])
        title = f"Sample {place} of {self._length}"
        return ShownSample(sample.arrays, sample.provenance, self.spec.recipe, title)

    def events(self, index: int) -> EventList:
        """List the events of the sample at ``index``, each with the time of its threshold crossing.

        Raises:
            IndexError, SampleUnavailable: as for ``dataset[index]``.
            VideoError: the video's frame rate is unknown.
        """
        events: EventList = self._open().events(self.seed, self.epoch, self._place(index))
        return events

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which selects other cameras and another order. Call it before a DataLoader starts workers.

        Raises:
            UsageError: it is out of range.
        """
        self._epoch = require_whole("epoch", epoch, 0, LARGEST_EPOCH)

    def __repr__(self) -> str:
        return f"V2VDataset({self._videos!r}, {counted(self._length, 'sample')}, seed {self.seed}, epoch {self.epoch})"

    def _repr_html_(self) -> str:
        recipe = self.spec.recipe
        shape = f"{recipe.voxels_per_clip} voxel grids of {recipe.bins} bins, {recipe.crop_width_px} x "
        rows = {"samples": self._length, "of": f"{shape}{recipe.crop_height_px} px", "arrays": ", ".join(self._arrays)}
        return html_table(f"V2VDataset of {self._videos}", rows | {"seed": self.seed, "epoch": self.epoch})

    def show(self, index: int = 0, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw one sample as a picture, which a notebook displays: ``dataset[index].show(path)``."""
        return self[index].show(path)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maker": None}

    def _place(self, index: int) -> int:
        number = as_whole(index)
        if number is None:
            raise UsageError(
                f"dataset[{format_value(index)}]: give one whole number; Subset(dataset, numbers) takes several"
            )
        place = number + self._length if number < 0 else number
        if not 0 <= place < self._length:
            raise IndexError(f"index {index}: the epoch has {counted(self._length, 'sample')}")
        return place

    def _open(self) -> Any:
        """Return this process's own remaker: an index file that was opened before a fork must not be read."""
        if self._maker is None or self._process != os.getpid():
            try:
                remake = importlib.import_module("v2v_tools.remake")
            except ModuleNotFoundError as error:
                needs = "V2VDataset, which makes samples in this process,"
                raise UsageError(name_extra(needs, error.name or "", "server")) from error
            kind = importlib.import_module("v2v_server.kinds.registry").kind_from(self._kind)
            self._maker = remake.open_remaker(
                self._videos, **self._source, kind=kind, spec=self.spec, arrays=self._arrays
            )
            self._process = os.getpid()
        return self._maker


def _collate(samples: Sequence[ShownSample], *, collate_fn_map: Any) -> Batch:
    tensors = {
        name: torch.stack([torch.from_numpy(sample.arrays[name]) for sample in samples]) for name in samples[0].arrays
    }
    return Batch(
        arrays=tensors,
        indices=tuple(sample.provenance.id.index for sample in samples),
        epoch=samples[0].provenance.id.epoch,
        provenance=tuple(sample.provenance for sample in samples),
        resume_state={},
        wait_seconds=0.0,
        cpu_seconds=0.0,
        decodes=len(samples),
        recipe=samples[0].recipe,
    )


# PyTorch's registry of collate functions for custom types.
default_collate_fn_map[ShownSample] = _collate
