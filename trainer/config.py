"""The configuration of a training run: six sections of small frozen dataclasses.

Section ``loss`` is that of the network's task: see :mod:`trainer.tasks`.

Keys are written with their section (``optimizer.learning_rate``), in files as nested mappings; every message names the
key that way. Files are read by :mod:`trainer.config_file`.
"""

from __future__ import annotations

import copy
import dataclasses
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from trainer.models import NETWORKS
from trainer.tasks import TASKS
from trainer.tasks.task import chosen, limited
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import LARGEST_SEED
from v2v_protocol.settings import Setting, format_value, nearest, of_type, settings_of
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import read_recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """The network.

    Attributes:
        name: see :data:`trainer.models.NETWORKS`.
        options: arguments of its constructor; ``bins`` comes from the recipe.
        weights: checkpoint to start from; ``shipped``: the network that comes with this package; empty: random weights.
    """

    name: str = chosen("e2vid", NETWORKS)
    options: Mapping[str, Any] = field(default_factory=dict)
    weights: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamConfig:
    """Where batches come from.

    Attributes:
        address: of a running server, or of several, separated by commas; empty: start one here, on ``videos``.
        videos, videos_kind, list, rows, workers: for that server, see ``v2v-serve --help``.
        batch_size: samples of one rank's batch.
        recipe: its name, its YAML file, or recipe fields (with ``preset`` to start from); never the server's default.
        seed: of all draws and of the order.
        spec: other fields of :class:`v2v_protocol.spec.StreamSpec`; missing ones have the server's default.
        loader_workers: processes of each rank that receive batches; 0: the training process receives them.
        timeout_seconds: silence after which the server counts as lost.
        insecure: without a key, also use another user's server on this host.
        mix: other streams whose batches are mixed in: a list of sections like this one, each with its ``weight`` (see
            :meth:`v2v_client.V2VStreamDataset.mix`). Keys that one leaves out are those of this section, and so are
            fields of its ``recipe``; but with ``videos`` it has no ``address`` or ``list`` of this section.
    """

    address: str = ""
    videos: str = ""
    videos_kind: str = "videos"
    list: str = ""
    rows: str = "full"
    workers: int = limited(2, 1, 4096)
    batch_size: int = limited(12, 1, 65_536)
    recipe: Any = "paper"
    seed: int = limited(0, 0, LARGEST_SEED)
    spec: Mapping[str, Any] = field(default_factory=dict)
    loader_workers: int = limited(0, 0, 64)
    timeout_seconds: float = limited(60.0, 0.1, 1e6)
    insecure: bool = False
    mix: Any = field(default_factory=lambda: [])  # noqa: PIE807 - here, `list` is the field above

    @property
    def mixed(self) -> dict[str, tuple[StreamConfig, float]]:
        """Return each stream with its weight, by the name of its section. This one has what the others leave.

        Raises:
            UsageError: ``mix`` is not a list of sections with weights.
        """
        own, rest, found = dataclasses.asdict(self) | {"mix": []}, 1.0, {}
        for number, item in enumerate(self.mix if isinstance(self.mix, list | tuple) else [None]):
            name, keys = f"stream.mix.{number}", dict(item) if isinstance(item, Mapping) else {}
            weight = keys.pop("weight", None)
            if not isinstance(weight, int | float) or not 0 <= weight <= rest or "mix" in keys:
                raise UsageError(
                    f"{name} = {format_value(item)}: give keys of section stream and weight, the share of its batches; "
                    "all weights together are at most 1"
                )
            rest = round(rest - weight, 9)
            base = own | ({"address": "", "list": ""} if "videos" in keys else {})
            if isinstance(keys.get("recipe"), Mapping):  # fields that it leaves out are those of this section
                keys["recipe"] = {**_fields(self.recipe), **keys["recipe"]}
            found[name] = _section(StreamConfig, name, base | keys), weight
        return {"stream": (self, rest), **found}

    @property
    def resolved_recipe(self) -> Recipe:
        """Return the recipe with all its fields.

        Raises:
            RecipeError: an unknown preset or field, or a value outside its limits.
        """
        return StreamSpec.from_dict({"recipe": _fields(self.recipe)}).recipe


def _fields(recipe: Any) -> Mapping[str, Any]:
    """Return the fields of a recipe that is given by its name, its YAML file or its fields."""
    recipe = read_recipe(recipe)
    return recipe if isinstance(recipe, Mapping) else {"preset": recipe}


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizerConfig:
    """How the loss is minimised.

    Attributes:
        name: "adam" or "adamw".
        learning_rate, weight_decay, amsgrad: PyTorch's.
        learning_rate_decay: factor at the end of each epoch; 1 keeps the rate.
        warmup_steps: steps in which the rate rises from 0.
        schedule: "cosine" lets the rate fall to 0 at the end of the run (``run.steps``, else ``run.epochs``).
        clip_gradient_norm: norm to which longer gradients are clipped; 0: no clipping.
        ema_decay: decay of the averaged network (see :class:`trainer.learner.AveragedNetwork`); 0: no average.
    """

    name: Literal["adam", "adamw"] = "adam"
    learning_rate: float = limited(1e-4, 1e-12, 1e3)
    weight_decay: float = limited(0.0, 0, 1e3)
    amsgrad: bool = True
    learning_rate_decay: float = limited(1.0, 1e-6, 1)
    warmup_steps: int = limited(0, 0, 10**9)
    schedule: Literal["constant", "cosine"] = "constant"
    clip_gradient_norm: float = limited(0.0, 0, 1e9)
    ema_decay: float = limited(0.0, 0, 0.999999)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeConfig:
    """Where and how the run computes.

    Attributes:
        device: "auto" takes a GPU if there is one.
        precision: "tf32" allows TF32 in a GPU's convolutions, as PyTorch does by itself; matrix products stay IEEE, as
            all products on a processor. "float32" computes IEEE float32 on a GPU too. "bfloat16" runs convolutions
            under autocast, while weights, sums of gradients, losses and pictures stay float32. Scores are IEEE float32
            with all three.
        cudnn_benchmark: let cuDNN time its convolution algorithms and use the fastest; shapes are constant in a run.
        pieces: parts of a batch that are computed one after another; their gradients are added, which saves memory.
        channels_last: use that memory format for the network; "auto": see :func:`trainer.learner.channels_last`.
        compile: what ``torch.compile`` compiles: "step" one iteration of each loop over time or over updates, in
            seconds, with PyTorch 2.7 or later; "clip" the network over the whole clip, unrolled, in minutes.
        cuda_graph: run forward and backward of a step as one CUDA graph, see :mod:`trainer.captured`.
        threads: threads of PyTorch on the CPU; 0: its own choice. Leave cores to the server's workers.
        seed: of the initial weights.
        group_timeout_seconds: time that a rank waits for the others in one exchange before the run fails.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "tf32", "bfloat16"] = "tf32"
    cudnn_benchmark: bool = True
    pieces: int = limited(1, 1, 65_536)
    channels_last: Any = "auto"
    compile: Literal["none", "step", "clip"] = "none"
    cuda_graph: bool = False
    threads: int = limited(0, 0, 1024)
    seed: int = limited(0, 0, 2**63 - 1)
    group_timeout_seconds: float = limited(7200.0, 1, 1e7)

    def __post_init__(self) -> None:
        if self.channels_last != "auto" and not isinstance(self.channels_last, bool):
            raise UsageError(
                f"compute.channels_last = {format_value(self.channels_last)}: give true, false or auto (default)"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """How long the run is, and what it keeps.

    Attributes:
        out: folder for checkpoints, TensorBoard files and previews.
        epochs: passes over the stream.
        steps, seconds: end earlier, after this number of optimiser steps or this time of the process; 0: no limit.
        log_every: steps between two readings of the losses (the only regular wait for the device).
        save_every: steps between two checkpoints; one is always written at the end.
        keep_epochs: number of latest epochs whose last step is also kept as a checkpoint of its own.
        judge_every: steps between two evaluations of the losses on a held-out batch of the stream; 0: none.
        judge_samples: samples of that batch, or fewer if an epoch has fewer.
        judge_videos: folder of the videos of the held-out batch; empty: the videos of the training.
        preview_every: steps between films of that batch; 0: none.
        preview_samples: number of its samples that are shown.
        validate: recordings (as ``v2v-eval --data``) that are scored at the ends of epochs; the best network so far is
            kept as best.pt. Empty: none.
        validate_config: YAML file of ``v2v-eval``, or the name of a shipped one, that says which data sets under
            ``validate`` are scored, in which time ranges and with which voxel grids. Empty: all recordings of the
            folder.
        validate_every: epochs between two scorings.
    """

    out: str = ""
    epochs: int = limited(1, 1, 1_000_000)
    steps: int = limited(0, 0, 10**12)
    seconds: float = limited(0.0, 0, 1e9)
    log_every: int = limited(20, 1, 10**9)
    save_every: int = limited(500, 1, 10**9)
    keep_epochs: int = limited(0, 0, 1_000_000)
    judge_every: int = limited(500, 0, 10**9)
    judge_samples: int = limited(4, 1, 64)
    judge_videos: str = ""
    preview_every: int = limited(500, 0, 10**9)
    preview_samples: int = limited(2, 1, 64)
    validate: str = ""
    validate_config: str = ""
    validate_every: int = limited(1, 1, 1_000_000)


_SET_ELSEWHERE = {
    "recipe": "set stream.recipe instead",
    **dict.fromkeys(("flow_direction", "flow_from"), "section loss decides"),
}
"""Fields of the spec that follow from other keys."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """One run.

    Attributes:
        loss: ``Settings`` of the network's task; None: all of their defaults.

    Raises:
        UsageError: an unknown key, or a value of the wrong kind, outside its limits or in conflict with another; the
            message names the key.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    loss: Any = None
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        task = TASKS[NETWORKS[self.network.name].task]
        if self.loss is None:
            object.__setattr__(self, "loss", task.Settings())
        for section, (stream, _) in self.stream.mixed.items():
            for name in ("lead_frames", "lead_voxels"):
                if isinstance(stream.recipe, Mapping) and name in stream.recipe:
                    raise UsageError(
                        f"{section}.recipe.{name}: leave it out, it follows from network.name and section loss"
                    )
            for name, remedy in _SET_ELSEWHERE.items():
                if name in stream.spec:
                    raise UsageError(f"{section}.spec.{name}: {remedy}")
            if StreamSpec.from_dict(stream.spec).recipe != Recipe():
                preset = stream.spec["preset"]
                raise UsageError(
                    f"{section}.spec.preset {preset} names a recipe: set {section}.recipe, and preset natural"
                )
            task.check(self.loss, stream.resolved_recipe)
        if "bins" in self.network.options:
            raise UsageError("network.options.bins: set stream.recipe.bins instead, the network follows it")
        if self.run.validate_config and not self.run.validate:
            raise UsageError(
                f"run.validate_config = {self.run.validate_config}: run.validate is missing; give the folder of the "
                "recordings"
            )

    def with_network_options(self, options: Mapping[str, Any], **changes: Any) -> TrainConfig:
        """Return this configuration with defaults for options of the network, and other changes of that section."""
        merged = {**options, **self.network.options}
        return dataclasses.replace(self, network=dataclasses.replace(self.network, options=merged, **changes))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Build a configuration from nested plain values; missing keys have their default.

        Raises:
            UsageError: an unknown key, or a value of the wrong type or outside its limits.
        """
        sections = {item.name: typing.get_type_hints(cls)[item.name] for item in dataclasses.fields(cls)}
        network = values.get("network")
        name = network.get("name", "e2vid") if isinstance(network, Mapping) else "e2vid"
        sections["loss"] = TASKS[NETWORKS[name].task if name in NETWORKS else "reconstruction"].Settings
        built = {}
        for name, content in values.items():
            if name not in sections:
                raise UsageError(f"unknown key {name!r}{nearest(name, sections)}; sections: {', '.join(sections)}")
            built[name] = _section(sections[name], name, content)
        return cls(**built)

    def to_dict(self) -> dict[str, Any]:
        """Return all keys as nested plain values."""
        return dataclasses.asdict(self)


def keys() -> str:
    """Return a line with all keys, section by section, ``loss`` for each task."""
    hints = typing.get_type_hints(TrainConfig)
    kinds = {name: kind for name, kind in hints.items() if name != "loss"}
    kinds |= {f"loss ({name})": task.Settings for name, task in TASKS.items()}
    return "; ".join(
        f"{name}: {', '.join(item.name for item in dataclasses.fields(kind))}" for name, kind in kinds.items()
    )


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the keys, with their section, whose values differ between two configurations, and both values."""
    left, right = _flat(ours), _flat(theirs)
    keys = sorted(left.keys() | right.keys())
    return {key: (left.get(key), right.get(key)) for key in keys if left.get(key) != right.get(key)}


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{section}.{key}": value for section, content in values.items() for key, value in content.items()}


def _section(kind: Any, name: str, content: Any) -> Any:
    if not isinstance(content, Mapping):
        raise UsageError(f"{name} = {format_value(content)}: it is a section, give keys and values")
    hints, stated = typing.get_type_hints(kind), settings_of(kind)
    for key in content:
        if key not in hints:
            raise UsageError(f"unknown key {name}.{key}{nearest(key, hints)}; known: {', '.join(hints)}")
    return kind(**{
        key: setting_of(f"{name}.{key}", hints[key], value, stated.get(key)) for key, value in content.items()
    })  # fmt: skip


def setting_of(key: str, hint: Any, value: Any, stated: Setting | None = None) -> Any:
    """Check a value against the setting of its key, or against its type, and return it in that type.

    Raises:
        UsageError: it has another type or is outside the limits; the message names the key.
    """
    setting = stated or of_type(hint)
    if setting is not None:
        return setting.check(key, value)
    if hint == Mapping[str, Any] and not isinstance(value, Mapping):
        raise UsageError(f"{key} = {format_value(value)}: give keys and values")
    return copy.deepcopy(value)
