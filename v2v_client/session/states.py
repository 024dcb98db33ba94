"""Define the states of a conversation with a server, and the events that change them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, auto


class State(Enum):
    """List the states of a conversation."""

    CLOSED = auto()  # before Hello, or after Goodbye
    GREETING = auto()  # Hello was sent
    WELCOMED = auto()  # the server has answered Hello


class Event(Enum):
    """List the events that change the state."""

    OPENED = auto()  # a link is open
    WELCOME = auto()  # the server answered Hello
    FORGOTTEN = auto()  # the server does not know the session: it was restarted, or the consumer was silent too long
    DISCONNECTED = auto()  # the network was interrupted and is back: messages under way in either direction may be lost
    UNANSWERED = auto()  # the server is alive, but no request was answered for a while: messages may be lost
    SILENCE = auto()  # nothing was received for the same time: the link may be broken and is opened again
    LEFT = auto()  # the consumer leaves: Goodbye


# Events without an entry change nothing.
TRANSITIONS: Mapping[State, Mapping[Event, State]] = {
    State.CLOSED: {
        Event.OPENED: State.GREETING,
    },
    State.GREETING: {
        Event.WELCOME: State.WELCOMED,
        Event.DISCONNECTED: State.GREETING,
        Event.SILENCE: State.GREETING,
        Event.LEFT: State.CLOSED,
    },
    State.WELCOMED: {
        Event.WELCOME: State.WELCOMED,
        Event.FORGOTTEN: State.GREETING,
        Event.DISCONNECTED: State.WELCOMED,
        Event.UNANSWERED: State.WELCOMED,
        Event.SILENCE: State.GREETING,
        Event.LEFT: State.CLOSED,
    },
}
