"""All kinds of videos: which one owns an id, which one a user asks for, and the flags of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields, make_dataclass, replace
from importlib import import_module
from typing import Any

from v2v_protocol.command import flag_of
from v2v_protocol.errors import UsageError
from v2v_protocol.settings import check_settings, settings_of, word
from v2v_server.kinds.kind import VideosKind

KIND_FILES = (
    "videos",
    "sequences",
    "photographs",
    "recordings",
)
"""Files of the kinds. The first is the default, and owns ids of all other endings, which a list may name."""
KINDS: dict[str, VideosKind] = {
    kind.name: kind for kind in (import_module(f"{__package__}.{file}").KIND for file in KIND_FILES)
}
"""Each kind by its name, with all flags at their defaults."""
VIDEOS = KINDS[KIND_FILES[0]]
_OWN = {item.name: item for kind in KINDS.values() for item in fields(kind)}
KindFlags: Any = make_dataclass(
    "KindFlags",
    [
        (
            "videos_kind", str,
            word(
                KIND_FILES[0], KINDS,
                f"what a video is: {'; '.join(f'{kind.name} is {kind.help}' for kind in KINDS.values())}",
                group="Kind of videos",
            ),
        ),
        *((name, item.type, field(default=item.default, metadata=item.metadata)) for name, item in _OWN.items()),
    ],
    frozen=True,
    namespace={"__post_init__": lambda self: check_settings(self, flag_of)},
)  # fmt: skip
"""The flags of all kinds as one dataclass of settings: for command lines, files of settings and their page."""


def kind_of(id: str) -> VideosKind:
    """Return the kind that owns the id of a catalogued video, with all flags at their defaults."""
    lower = id.lower()
    return next((kind for kind in KINDS.values() if lower.endswith(kind.endings)), VIDEOS)


def kind_from(given: Mapping[str, Any]) -> VideosKind:
    """Return the kind that flags state.

    Args:
        given: values of :data:`KindFlags` by name, among others; None or no value stands for the default.

    Raises:
        UsageError: a value is outside its limits, or of another kind's flag.
    """
    asked = KindFlags(**{each.name: given[each.name] for each in fields(KindFlags) if given.get(each.name) is not None})
    kind, own = KINDS[asked.videos_kind], dict[str, Any]()
    for name, setting in settings_of(KindFlags).items():
        if name in kind.settings:
            own[name] = getattr(asked, name)
        elif name != "videos_kind" and getattr(asked, name) != setting.default:
            having = " or ".join(other.name for other in KINDS.values() if name in other.settings)
            what = f"{flag_of(name)} {getattr(asked, name)} has no effect without --videos-kind {having}"
            raise UsageError(f"{what} (now {kind.name}); give both, or neither")
    return replace(kind, **own)
