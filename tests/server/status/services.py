"""A status publisher over fake peers."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, cast

from tests.server.named_corpus import corpus, video
from tests.server.peers import Peers
from tests.server.queues import Queues, ToyPool
from v2v_protocol.messages import Status as StatusMessage
from v2v_protocol.messages import decode
from v2v_server.broker.state import Action, SendStatus, ToConsumer, ToWorker
from v2v_server.config import ServeConfig
from v2v_server.status.snapshot import StatusFields, StatusPublisher, to_json

WALL = "2024-02-29T12:00:00+00:00"


class View(dict[str, Any]):
    """A status with its values as attributes too."""

    def __getattr__(self, name: str) -> Any:
        return _viewed(self[name])


def _viewed(value: Any) -> Any:
    if isinstance(value, dict):
        return View(value)
    return [_viewed(each) for each in value] if isinstance(value, list) else value


@dataclass
class Published:
    """A publisher.

    Attributes:
        at: the peers whose service it publishes; their clock is its.
        publisher: the publisher.
        transport: it waited for messages all the time, unless a test says otherwise.
        pool: of the server's own workers.
    """

    at: Peers
    publisher: StatusPublisher
    transport: Queues
    pool: ToyPool

    def status(self) -> StatusFields:
        return self.publisher.status(self.at.now)

    def plain(self) -> dict[str, Any]:
        """Return what a client receives."""
        values: dict[str, Any] = json.loads(to_json(self.status()))
        return values

    def view(self) -> View:
        return View(self.status())

    def answers(self) -> list[ToConsumer | ToWorker]:
        """Return the answers of one tick."""
        return self.publisher.tick(self.at.now)

    def pass_seconds(self, seconds: float, busy_share: float = 0.0) -> None:
        """Let time pass, in ticks of a tenth of a second; for some of it the loop waits for no message."""
        for _ in range(round(seconds * 10)):
            self.at.now += 0.1
            self.transport.waited_seconds += 0.1 * (1.0 - busy_share)
            self.publisher.tick(self.at.now)

    def ask(self, actions: list[Action]) -> None:
        (request,) = actions
        self.publisher.ask(cast(SendStatus, request))


def published(at: Peers, **settings: Any) -> Published:
    """Return a publisher that begins now."""
    config = ServeConfig.load(None, {"videos": "videos"} | settings)
    transport, pool = Queues(), ToyPool(lambda name, address: None)
    catalogue = corpus(*(video(f"v{number}.mp4") for number in range(5)))
    publisher = StatusPublisher(config, catalogue, at.broker, pool, transport, at.now, lambda: WALL)
    publisher._processor_clock = lambda: 0.0  # a slow host builds a status less often
    publisher.tick(at.now)
    return Published(at, publisher, transport, pool)


def json_of(action: ToConsumer | ToWorker) -> bytes:
    """Return the JSON of an answer."""
    message = decode(action.frames[0])
    if not isinstance(message, StatusMessage):
        raise AssertionError(message)
    return message.json
