"""Both buses within one process, without a network: for in-process runs and for tests.

Messages are encoded, checked and decoded as over Zenoh.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.bus import Bus
from protocol.errors import BusError
from protocol.inbox import Inbox, Presence, RawMessage
from protocol.messages import Message
from protocol.topics import TOPICS, BusName, Topic
from protocol.traffic import Traffic, framed_bytes
from protocol.wire import encode


@dataclass(frozen=True, slots=True, eq=False)
class _Subscription:
    parts: Mapping[str, str]
    bus: InProcessBus

    def takes(self, parts: Mapping[str, str]) -> bool:
        return all(parts[name] == value for name, value in self.parts.items())


@dataclass(slots=True, eq=False)
class InProcessRouter:
    """One bus's router: subscriptions, present processes and watchers of their presence."""

    name: BusName = BusName.V2X
    subscriptions: dict[str, list[_Subscription]] = field(default_factory=dict)
    present: list[Presence] = field(default_factory=list)
    watching: list[Inbox] = field(default_factory=list)
    buses: list[InProcessBus] = field(default_factory=list)

    def bus(self, inbox: Inbox) -> InProcessBus:
        """Returns one process's access; what arrives goes to its inbox."""
        return InProcessBus(self, inbox)

    def topic(self, name: str) -> Topic:
        """Returns a topic of this bus.

        Raises:
            BusError: it belongs to the other one.
        """
        topic = TOPICS[name]
        if topic.bus is not self.name:
            raise BusError(f"topic {name} belongs to the {topic.bus.value} bus")
        return topic

    def notify(self, presence: Presence) -> None:
        """Notifies watchers that a process appeared or left."""
        for inbox in self.watching:
            inbox.put(presence)


class InProcessBus:
    """See `protocol.bus.Bus`. Nothing is lost or late; bytes of TCP are computed."""

    def __init__(self, router: InProcessRouter, inbox: Inbox) -> None:
        router.buses.append(self)
        self._router = router
        self._inbox = inbox
        self._own: list[tuple[str, _Subscription]] = []
        self._announced: list[Presence] = []
        self._watches = False
        self._traffic = Traffic()

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        """See `Bus.publish`."""
        data = encode(message)
        self.deliver(topic_name, data, **parts)
        return len(data)

    def deliver(self, topic_name: str, data: bytes, **parts: str) -> None:
        """Delivers bytes, valid or not, to all subscribers of the topic and these parts."""
        topic = self._router.topic(topic_name)
        raw = RawMessage(topic, topic.key(**parts), data, time.monotonic_ns())
        self._traffic = self._traffic.sent(framed_bytes(raw.key, len(data)))
        for subscription in self._router.subscriptions.get(topic_name, ()):
            if subscription.takes(parts):
                subscription.bus.take(raw)

    def take(self, raw: RawMessage) -> None:
        """Receives a message that this bus subscribes to."""
        self._traffic = self._traffic.received(framed_bytes(raw.key, len(raw.data)))
        self._inbox.put(raw)

    def subscribe(self, topic_name: str, **parts: str) -> None:
        """See `Bus.subscribe`."""
        self._router.topic(topic_name)
        subscription = _Subscription(parts, self)
        self._router.subscriptions.setdefault(topic_name, []).append(subscription)
        self._own.append((topic_name, subscription))

    def unsubscribe(self, topic_name: str, **parts: str) -> None:
        """See `Bus.unsubscribe`."""
        ended = next(one for one in self._own if one[0] == topic_name and one[1].parts == parts)
        self._own.remove(ended)
        self._router.subscriptions[topic_name].remove(ended[1])

    def announce(self, role: str, process_id: str) -> None:
        """See `Bus.announce`."""
        presence = Presence(role, process_id, True, self._router.name)
        self._router.present.append(presence)
        self._announced.append(presence)
        self._router.notify(presence)

    def watch(self) -> None:
        """See `Bus.watch`."""
        self._watches = True
        self._router.watching.append(self._inbox)
        for presence in self._router.present:
            self._inbox.put(presence)

    def router(self) -> str:
        """See `Bus.router`."""
        return self._router.name.value

    def wire_bytes(self) -> int:
        """See `Bus.wire_bytes`."""
        return 0

    def traffic(self) -> Traffic:
        """See `Bus.traffic`; computed as if each message travelled alone over Zenoh and TCP."""
        return self._traffic

    def unsent_bytes(self) -> int:
        """See `Bus.unsent_bytes`."""
        return 0

    def close(self) -> None:
        """See `Bus.close`."""
        self._router.buses.remove(self)
        for topic_name, subscription in self._own:
            self._router.subscriptions[topic_name].remove(subscription)
        if self._watches:
            self._router.watching.remove(self._inbox)
        for presence in self._announced:
            self._router.present.remove(presence)
            self._router.notify(Presence(presence.role, presence.id, False, self._router.name))
        self._own, self._announced, self._watches = [], [], False


_: type[Bus] = InProcessBus  # types are checked: it is all that a role needs
