"""What a training run can be told: six sections of small frozen dataclasses.

Section ``loss`` is that of the network's task: see :mod:`trainer.tasks`.

Keys are written with their section (``optimizer.learning_rate``), in files as nested mappings; every message names the
key that way. Files are read by :mod:`trainer.config_file`.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from trainer.models import NETWORKS
from trainer.tasks import TASKS
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import LARGEST_SEED
from v2v_protocol.spec import StreamSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """What is trained.

    Attributes:
        name: see :data:`trainer.models.NETWORKS`.
        options: arguments of its constructor; ``bins`` comes from the recipe.
        weights: checkpoint to take the first weights from; empty: random.
    """

    name: str = "e2vid"
    options: Mapping[str, Any] = field(default_factory=dict)
    weights: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamConfig:
    """Where batches come from.

    Attributes:
        address: of a running server; empty: one is started here, on ``videos``.
        videos, list, rows, workers: for that server, see ``v2v-serve --help``.
        batch_size: samples of one rank's batch.
        recipe: preset name, or recipe fields (with ``preset`` to start from); never the server's default.
        seed: of all draws and of the order.
        spec: other fields of :class:`v2v_protocol.spec.StreamSpec`; what is missing is the server's default.
        loader_workers: processes that receive for each rank; 0: the training process does.
        timeout_seconds: silence after which the server counts as lost.
    """

    address: str = ""
    videos: str = ""
    list: str = ""
    rows: str = "full"
    workers: int = 2
    batch_size: int = 12
    recipe: Any = "paper"
    seed: int = 0
    spec: Mapping[str, Any] = field(default_factory=dict)
    loader_workers: int = 0
    timeout_seconds: float = 60.0

    @property
    def resolved_recipe(self) -> Recipe:
        """The recipe with all its fields.

        Raises:
            RecipeError: it is none.
        """
        named = self.recipe if isinstance(self.recipe, Mapping) else {"preset": self.recipe}
        return Recipe.from_dict(named)


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizerConfig:
    """How it is minimised.

    Attributes:
        name: "adam" or "adamw".
        learning_rate, weight_decay, amsgrad: PyTorch's.
        learning_rate_decay: factor at the end of each epoch; 1 keeps the rate.
        warmup_steps: in which the rate rises from 0.
        schedule: "cosine" lets the rate fall to 0 at the end of the run (``run.steps``, else ``run.epochs``).
        clip_gradient_norm: gradients longer than this are shortened to it; 0: never.
        ema_decay: of the averaged network (see :class:`trainer.learner.AveragedNetwork`); 0: none.
    """

    name: Literal["adam", "adamw"] = "adam"
    learning_rate: float = 1e-4
    weight_decay: float = 0.0
    amsgrad: bool = True
    learning_rate_decay: float = 1.0
    warmup_steps: int = 0
    schedule: Literal["constant", "cosine"] = "constant"
    clip_gradient_norm: float = 0.0
    ema_decay: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeConfig:
    """On what.

    Attributes:
        device: "auto" takes a GPU if there is one.
        precision: "float32" is IEEE's also on a GPU; "tf32" allows its shorter products; "bfloat16" runs convolutions
            under autocast, while weights, losses and pictures stay float32.
        pieces: a batch is computed in so many pieces whose gradients are added up: less memory, the same step.
        channels_last: memory format of the network.
        compile: through ``torch.compile``.
        threads: of PyTorch on the CPU; 0: its own choice. Leave cores to the server's workers.
        seed: of the first weights.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "tf32", "bfloat16"] = "float32"
    pieces: int = 1
    channels_last: bool = False
    compile: bool = False
    threads: int = 0
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """How long, and what is kept.

    Attributes:
        out: folder for checkpoints, TensorBoard files and previews.
        epochs: passes over the stream.
        steps, seconds: end earlier, after so many optimiser steps or so much time of this process; 0: no such limit.
        log_every: steps between two readings of the losses (the only regular wait for the device).
        save_every: steps between two checkpoints; there is always one at the end.
        keep_epochs: also keep checkpoints of the ends of the last so many epochs.
        judge_every: steps between two looks at a held-out batch of the stream; 0: none.
        judge_samples: samples of it, if an epoch has so many.
        preview_every: steps between films of that batch; 0: none.
        preview_samples: how many of its samples they show.
    """

    out: str = ""
    epochs: int = 1
    steps: int = 0
    seconds: float = 0.0
    log_every: int = 20
    save_every: int = 500
    keep_epochs: int = 0
    judge_every: int = 500
    judge_samples: int = 4
    preview_every: int = 500
    preview_samples: int = 2


_LIMITS: dict[str, tuple[float, float]] = {
    "stream.workers": (1, 4096),
    "stream.batch_size": (1, 65_536),
    "stream.seed": (0, LARGEST_SEED),
    "stream.loader_workers": (0, 64),
    "stream.timeout_seconds": (0.1, 1e6),
    "optimizer.learning_rate": (1e-12, 1e3),
    "optimizer.weight_decay": (0, 1e3),
    "optimizer.learning_rate_decay": (1e-6, 1),
    "optimizer.warmup_steps": (0, 10**9),
    "optimizer.clip_gradient_norm": (0, 1e9),
    "optimizer.ema_decay": (0, 0.999999),
    "compute.pieces": (1, 65_536),
    "compute.threads": (0, 1024),
    "compute.seed": (0, 2**63 - 1),
    "run.epochs": (1, 1_000_000),
    "run.steps": (0, 10**12),
    "run.seconds": (0, 1e9),
    "run.log_every": (1, 10**9),
    "run.save_every": (1, 10**9),
    "run.keep_epochs": (0, 1_000_000),
    "run.judge_every": (0, 10**9),
    "run.judge_samples": (1, 64),
    "run.preview_every": (0, 10**9),
    "run.preview_samples": (1, 64),
}

_SET_ELSEWHERE = {
    "recipe": "set stream.recipe instead",
    **dict.fromkeys(("flow_direction", "flow_from"), "section loss decides"),
}
"""Fields of the spec that follow from other keys."""

_KINDS: dict[Any, tuple[type[Any], str]] = {
    float: (float, "a number"),
    int: (int, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "text"),
    Mapping[str, Any]: (Mapping, "keys and values"),
    Any: (object, "a value"),
}

_CHOICES: dict[str, Collection[str]] = {"network.name": NETWORKS}


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
        for name in ("lead_frames", "lead_voxels"):
            if isinstance(self.stream.recipe, Mapping) and name in self.stream.recipe:
                raise UsageError(f"stream.recipe.{name}: leave it out, it follows from network.name and section loss")
        for name, remedy in _SET_ELSEWHERE.items():
            if name in self.stream.spec:
                raise UsageError(f"stream.spec.{name}: {remedy}")
        StreamSpec.from_dict(self.stream.spec)
        if "bins" in self.network.options:
            raise UsageError("network.options.bins: set stream.recipe.bins instead, the network follows it")
        task.check(self.loss, self.stream.resolved_recipe)

    def with_network_options(self, options: Mapping[str, Any], **changes: Any) -> TrainConfig:
        """This configuration with more options of the network, behind those that it has, and other changes of it."""
        merged = {**options, **self.network.options}
        return dataclasses.replace(self, network=dataclasses.replace(self.network, options=merged, **changes))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """From nested plain values; what is missing keeps its default."""
        sections = {item.name: typing.get_type_hints(cls)[item.name] for item in dataclasses.fields(cls)}
        network = values.get("network")
        name = network.get("name", "e2vid") if isinstance(network, Mapping) else "e2vid"
        sections["loss"] = TASKS[NETWORKS[name].task if name in NETWORKS else "reconstruction"].Settings
        built = {}
        for name, content in values.items():
            if name not in sections:
                raise UsageError(f"unknown key {name!r}{_nearest(name, sections)}; sections: {', '.join(sections)}")
            built[name] = _section(sections[name], name, content)
        return cls(**built)

    def to_dict(self) -> dict[str, Any]:
        """All keys as nested plain values."""
        return dataclasses.asdict(self)


def keys() -> str:
    """All keys, for people: section by section, ``loss`` for each task."""
    hints = typing.get_type_hints(TrainConfig)
    kinds = {name: kind for name, kind in hints.items() if name != "loss"}
    kinds |= {f"loss ({name})": task.Settings for name, task in TASKS.items()}
    return "; ".join(
        f"{name}: {', '.join(item.name for item in dataclasses.fields(kind))}" for name, kind in kinds.items()
    )


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Keys (with their section) in which two configurations in plain values differ, and both values."""
    left, right = _flat(ours), _flat(theirs)
    keys = sorted(left.keys() | right.keys())
    return {key: (left.get(key), right.get(key)) for key in keys if left.get(key) != right.get(key)}


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{section}.{key}": value for section, content in values.items() for key, value in content.items()}


def _section(kind: type[Any], name: str, content: Any) -> Any:
    if not isinstance(content, Mapping):
        raise UsageError(f"{name} = {content!r}: it is a section, give keys and values")
    hints = typing.get_type_hints(kind)
    stated = {item.name: item.metadata for item in dataclasses.fields(kind)}
    for key in content:
        if key not in hints:
            raise UsageError(f"unknown key {name}.{key}{_nearest(str(key), hints)}; known: {', '.join(hints)}")
    return kind(**{key: setting_of(f"{name}.{key}", hints[key], value, stated[key]) for key, value in content.items()})


def setting_of(key: str, hint: Any, value: Any, stated: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """``value`` in the kind that ``hint`` says, within the limits, and of the words, that are stated for its key.

    Raises:
        UsageError: it is of another kind, or outside; the message names the key.
    """
    words = stated.get("words") or _CHOICES.get(key)
    if typing.get_origin(hint) is Literal or words:
        words = words or typing.get_args(hint)
        if value not in words:
            raise UsageError(f"{key} = {value!r}: choose one of {', '.join(words)}")
        return value
    if hint is float:
        value = _number(key, value)
    kind, word = _KINDS[hint]
    if not isinstance(value, kind) or (hint is int and isinstance(value, bool)):
        raise UsageError(f"{key} = {value!r}: give {word}")
    limits = stated.get("limits") or _LIMITS.get(key)
    if limits:
        low, high = limits
        if not low <= value <= high:
            raise UsageError(f"{key} = {value!r}: give {word} from {low:g} to {high:g}")
    return copy.deepcopy(value)


def _number(key: str, value: Any) -> float:
    # YAML 1.1 reads 1e-4, without a point, as text.
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise UsageError(f"{key} = {value!r}: give a number")
    try:
        return float(value)
    except ValueError as error:
        raise UsageError(f"{key} = {value!r}: give a number") from error


def _nearest(word: str, known: Any) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
