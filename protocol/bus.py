"""The two publish-subscribe buses over Zenoh. The only module that imports Zenoh.

One process of the system hosts a bus's router and listens; all others connect to it as clients.
Shared memory is off: bytes that never cross the socket could not be counted, and messages in the
memory of a process that has ended, or that was not scheduled for a while, are lost.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import zenoh

from protocol.access import Keys, Members, access_control
from protocol.errors import BusError, MessageError
from protocol.inbox import Envelope, Inbox, Presence, RawMessage
from protocol.messages import Message
from protocol.tcpinfo import sent_bytes, traffic, unsent_bytes
from protocol.topics import (
    ALIVE,
    ALIVE_IN_ANY,
    TOPICS,
    BusName,
    Delivery,
    Topic,
    alive_parts,
)
from protocol.traffic import Traffic
from protocol.wire import decode, encode

__all__ = [
    "Bus",
    "Endpoint",
    "Envelope",
    "Inbox",
    "Presence",
    "ZenohBus",
    "open_bus",
    "settings_of",
    "unanswered",
    "with_send_buffer",
]

M = TypeVar("M", bound=Message)
_Read = Callable[[zenoh.Sample], RawMessage | Presence | None]
_Take = Callable[[zenoh.Sample], None]

CONNECT_TIMEOUT_MS = 60_000
NOBODY = Members({})
LEASE_MS = 20_000  # a process may be stopped for so long; its death shows as the end of its TCP
SEND_BUFFER_BYTES = 1 << 20  # the kernel caps it at net.core.wmem_max
_PRIORITY = {
    Delivery.BULK: zenoh.Priority.DATA,
    Delivery.PROMPT: zenoh.Priority.INTERACTIVE_HIGH,
    Delivery.TELEMETRY: zenoh.Priority.DATA_LOW,
}

_OBSERVER_IDS = tuple(f"c9{number:03x}f" for number in range(1024))
"""Session ids of observers that yield: so many that two hardly ever choose the same one.

A router forwards to one receiver after the other: an observer that is stopped, or behind a slow
network, would block all others for 5 s. Every router drops messages to these ids when their link is
full.
"""


def observer_id() -> str:
    """Returns a session id for an observer that yields."""
    return secrets.choice(_OBSERVER_IDS)


def drop_for_observers() -> list[dict[str, Any]]:
    """Returns a router's setting `qos/network`, which drops messages to slow observers."""
    return [
        {
            "id": "observers",
            "zids": list(_OBSERVER_IDS),
            "flows": ["egress"],
            "messages": ["put"],
            "key_exprs": ["**"],
            "overwrite": {"congestion_control": "drop"},
        }
    ]


class Bus(Protocol):
    """Interface of a bus, as roles use it; received messages go to the inbox it was made with."""

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        """Sends a message; the parts fill the topic's key. Returns its size in bytes."""

    def subscribe(self, topic_name: str, **parts: str) -> None:
        """Subscribes to a topic; parts that are not given match everything."""

    def unsubscribe(self, topic_name: str, **parts: str) -> None:
        """Ends a subscription that was made with the same parts."""

    def announce(self, role: str, process_id: str) -> None:
        """Declares this process present by a liveliness token, until the bus is closed."""

    def watch(self) -> None:
        """Subscribes to the liveliness tokens of all processes, those already present included."""

    def router(self) -> str:
        """Returns the name of the router that this bus is connected to now; empty if to none."""

    def wire_bytes(self) -> int:
        """Returns the bytes that TCP has sent for this bus, 0 if it is not one connection."""

    def traffic(self) -> Traffic:
        """Returns the traffic of its connection in both directions, as IP packets."""

    def unsent_bytes(self) -> int:
        """Returns the bytes that TCP holds back because the link is full."""

    def close(self) -> None:
        """Closes the bus; its liveliness tokens vanish."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address of a bus: `listen` hosts its router at the locator, otherwise connect to it.

    With keys the locator is a TLS one, and what a certificate is not permitted to do is refused. A
    client that `yields` loses messages when it is too slow, instead of blocking publishers.
    """

    locator: str
    listen: bool
    keys: Keys | None = None
    yields: bool = False

    def __str__(self) -> str:
        return f"{'listen' if self.listen else 'connect'}:{self.locator}"

    @classmethod
    def parse(cls, text: str) -> Endpoint:
        """Reads `listen:tcp/HOST:PORT` or `connect:tls/HOST:PORT`, without keys."""
        verb, _, locator = text.partition(":")
        if verb not in ("listen", "connect") or not locator:
            raise BusError(f"endpoint {text!r}: needs listen:LOCATOR or connect:LOCATOR")
        return cls(locator, verb == "listen")


class ZenohBus:
    """A bus over one Zenoh session."""

    def __init__(self, session: zenoh.Session, name: BusName, inbox: Inbox) -> None:
        self._session = session
        self._name = name
        self._inbox = inbox
        self._kept: list[object] = []
        self._subscribers: dict[str, zenoh.Subscriber[None]] = {}

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        """See `Bus.publish`; blocks while the link is full."""
        topic = self._topic(topic_name)
        data = encode(message)
        try:
            self._session.put(
                topic.key(**parts),
                data,
                priority=_PRIORITY[topic.delivery],
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=topic.delivery is Delivery.PROMPT,
            )
        except zenoh.ZError as error:
            raise BusError(f"cannot send on {topic_name}: {error}") from None
        return len(data)

    def subscribe(self, topic_name: str, **parts: str) -> None:
        """See `Bus.subscribe`."""
        topic = self._topic(topic_name)

        def read(sample: zenoh.Sample) -> RawMessage:
            now_ns = time.monotonic_ns()
            return RawMessage(topic, str(sample.key_expr), sample.payload.to_bytes(), now_ns)

        key = topic.key(**parts)
        self._subscribers[key] = self._session.declare_subscriber(key, self._into_inbox(read))

    def unsubscribe(self, topic_name: str, **parts: str) -> None:
        """See `Bus.unsubscribe`."""
        self._subscribers.pop(self._topic(topic_name).key(**parts)).undeclare()  # type: ignore[no-untyped-call]  # zenoh is untyped here

    def announce(self, role: str, process_id: str) -> None:
        """See `Bus.announce`."""
        key = f"{ALIVE}/{role}/{process_id}"
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch(self) -> None:
        """See `Bus.watch`."""

        def read(sample: zenoh.Sample) -> Presence | None:
            try:
                role, process_id = alive_parts(str(sample.key_expr))
            except MessageError as error:
                self._inbox.refuse(ALIVE, error)
                return None
            return Presence(role, process_id, sample.kind == zenoh.SampleKind.PUT, self._name)

        tokens = self._session.liveliness()
        handler = self._into_inbox(read)
        self._kept.append(tokens.declare_subscriber(f"{ALIVE}/*/*", handler, history=True))

    def serve(self, topic_name: str, message: Message) -> None:
        """Replies to queries of this topic with this message."""
        data = encode(message)
        self._answer(topic_name, lambda: data)

    def answer(self, topic_name: str, make: Callable[[], Message]) -> None:
        """Replies to queries of this topic with a message made for each."""
        self._answer(topic_name, lambda: encode(make()))

    def ask(self, topic_name: str, message: type[M], timeout_s: float) -> M | None:
        """Queries the router's host and returns its answer, None if none comes in time.

        Raises:
            ProtocolError: the answer is not such a message.
        """
        for reply in self._session.get(self._topic(topic_name).key(), timeout=timeout_s):
            if reply.ok is not None:
                return decode(reply.ok.payload.to_bytes(), message)
        return None

    def list_present(self, timeout_s: float) -> list[tuple[str, str, str]]:
        """Returns protocol version, role and id of all processes present, of any version."""
        replies = self._session.liveliness().get(ALIVE_IN_ANY, timeout=timeout_s)
        keys = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        names = {(key[1], key[3], key[4]) for key in keys if len(key) == 5}  # no `**` among them
        return sorted(names)

    def _into_inbox(self, read: _Read) -> _Take:
        """Returns the callback that puts all messages of a subscription into the inbox."""

        def take(sample: zenoh.Sample) -> None:
            if (item := read(sample)) is not None:
                self._inbox.put(item)

        return take

    def _answer(self, topic_name: str, make: Callable[[], bytes]) -> None:
        key = self._topic(topic_name).key()
        queryable = self._session.declare_queryable(key, lambda query: query.reply(key, make()))
        self._kept.append(queryable)

    def router(self) -> str:
        """See `Bus.router`; who hosts it is connected to none."""
        return ",".join(sorted(str(zid) for zid in self._session.info.routers_zid()))

    def wire_bytes(self) -> int:
        """See `Bus.wire_bytes`."""
        locator = self._locator()
        return sent_bytes(locator) if locator else 0

    def traffic(self) -> Traffic:
        """See `Bus.traffic`; nothing of a bus that is not one connection."""
        locator = self._locator()
        return traffic(locator) if locator else Traffic()

    def unsent_bytes(self) -> int:
        """See `Bus.unsent_bytes`."""
        locator = self._locator()
        return unsent_bytes(locator) if locator else 0

    def close(self) -> None:
        """See `Bus.close`."""
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh is untyped here

    def _locator(self) -> str | None:
        links = self._session.info.links()
        return str(links[0].src) if len(links) == 1 else None

    def _topic(self, name: str) -> Topic:
        topic = TOPICS[name]
        if topic.bus is not self._name:
            raise BusError(f"topic {name} belongs to the {topic.bus.value} bus")
        return topic


def open_bus(
    name: BusName,
    endpoint: Endpoint,
    inbox: Inbox,
    timeout_ms: int | None = None,
    members: Members | None = None,
) -> ZenohBus:
    """Opens a bus, as its router's host or as a client that waits for the host.

    A host with keys lets `members` alone publish and subscribe.

    Raises:
        BusError: the port is in use, or nothing answers there in time.
    """
    return ZenohBus(_open_session(name, endpoint, timeout_ms, members), name, inbox)


def with_send_buffer(endpoint: Endpoint) -> Endpoint:
    """Returns the endpoint with a socket send buffer that takes a whole scan if the link is full.

    Then publishing does not block, and the kernel reports how many bytes wait.
    """
    return replace(endpoint, locator=f"{endpoint.locator}#so_sndbuf={SEND_BUFFER_BYTES}")


def unanswered(name: BusName, endpoint: Endpoint, waited_s: float) -> str:
    """Returns the error text for a bus that did not answer in time."""
    host = endpoint.locator.partition("/")[2].rpartition(":")[0]
    why = "without --keys"
    if endpoint.keys:
        why = f"with a certificate of the same authority that names {host}"
    return (
        f"nothing answers at {endpoint.locator} for the {name.value} bus "
        f"(waited {waited_s:g} s); is the other side up, {why}?"
    )


def _open_session(
    name: BusName,
    endpoint: Endpoint,
    timeout_ms: int | None = None,
    members: Members | None = None,
) -> zenoh.Session:
    timeout_ms = CONNECT_TIMEOUT_MS if timeout_ms is None else timeout_ms
    try:
        return zenoh.open(_config(name, endpoint, timeout_ms, members or NOBODY))
    except zenoh.ZError as error:
        raise BusError(_explain(name, endpoint, timeout_ms, str(error))) from None


def settings_of(keys: Keys | None) -> dict[str, object]:
    """Returns the Zenoh settings, by their paths, that all sessions and routers share."""
    shared: dict[str, object] = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/shared_memory/enabled": False,
    }
    return shared if keys is None else shared | {"transport/link/tls": keys.settings()}


def _config(name: BusName, endpoint: Endpoint, timeout_ms: int, members: Members) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, object] = {
        **settings_of(endpoint.keys),
        "mode": "router" if endpoint.listen else "client",
        "listen/endpoints": [endpoint.locator] if endpoint.listen else [],
        "connect/endpoints": [] if endpoint.listen else [endpoint.locator],
        "connect/timeout_ms": timeout_ms,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 400, "period_increase_factor": 2},
    }
    if endpoint.listen:
        settings["qos/network"] = drop_for_observers()
    elif endpoint.yields:
        settings["id"] = observer_id()
    if endpoint.keys is not None and endpoint.listen:
        settings["access_control"] = access_control(name, members)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _explain(name: BusName, endpoint: Endpoint, timeout_ms: int, error: str) -> str:
    if "in use" in error:
        return (
            f"cannot listen at {endpoint.locator} for the {name.value} bus: the port is in use; "
            "stop what uses it or choose another with --listen"
        )
    if not endpoint.listen:
        return unanswered(name, endpoint, timeout_ms / 1000)
    return (
        f"cannot listen at {endpoint.locator} for the {name.value} bus: {error.split(' at /')[0]}"
    )


_: type[Bus] = ZenohBus  # types are checked: it is all that a role needs
