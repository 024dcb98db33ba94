"""The watch over fake peers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

from tests.server.named_corpus import corpus, video
from tests.server.peers import Peers
from tests.server.queues import Queues, ToySupervisor
from v2v_protocol.messages import Status
from v2v_protocol.wire import decode
from v2v_server.broker.actions import Action, SendStatus, ToConsumer, ToWorker
from v2v_server.config import ServeConfig
from v2v_server.status.publisher import StatusPublisher, make_publisher
from v2v_server.status.state import ServiceState

WALL = "2024-02-29T12:00:00+00:00"


@dataclass
class Watched:
    """A watch.

    Attributes:
        at: whom it watches; their clock is its.
        watch: over them.
        transport: which waited for messages all the time, unless a test says otherwise.
        supervisor: of the server's own workers.
    """

    at: Peers
    watch: StatusPublisher
    transport: Queues
    supervisor: ToySupervisor

    def state(self) -> ServiceState:
        return self.watch.state(self.at.now)

    def answers(self) -> list[ToConsumer | ToWorker]:
        """Of one tick."""
        return self.watch.tick(self.at.now)

    def pass_seconds(self, seconds: float, busy_share: float = 0.0) -> None:
        """Time passes, in ticks of a tenth of a second; for some of it the loop waits for no message."""
        for _ in range(round(seconds * 10)):
            self.at.now += 0.1
            self.transport.waited_seconds += 0.1 * (1.0 - busy_share)
            self.watch.tick(self.at.now)

    def ask(self, actions: list[Action]) -> list[ToConsumer | ToWorker]:
        (show,) = actions
        return self.watch.ask(cast(SendStatus, show))


def service(at: Peers, **settings: Any) -> Watched:
    """A watch that begins now."""
    config = ServeConfig.load(None, {"videos": "videos"} | settings)
    transport, supervisor = Queues(), ToySupervisor(lambda name, address: None)
    catalogue = corpus(*(video(f"v{number}.mp4") for number in range(5)))
    watch = make_publisher(config, catalogue, at.dispatcher, supervisor, at.quarantine, transport, at.now, lambda: WALL)
    watch._processor_clock = lambda: 0.0  # a slow host makes states less often
    watch.tick(at.now)
    return Watched(at, watch, transport, supervisor)


def seen(action: ToConsumer | ToWorker) -> bytes:
    """The JSON of an answer."""
    message = decode(action.frames[0])
    if not isinstance(message, Status):
        raise AssertionError(message)
    return message.json
