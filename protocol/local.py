"""Buses within one process, for tests and replay: same bytes, same checks, no network."""

from __future__ import annotations

import time
from dataclasses import replace
from fnmatch import fnmatchcase

from protocol.inbox import Inbox, Presence, Sealed
from protocol.messages import Message
from protocol.topics import TOPICS, BusName, Topic
from protocol.wire import encode


class LocalNetwork:
    """Connects the buses that it makes."""

    def __init__(self, name: BusName = BusName.V2X) -> None:
        self.name = name
        self.buses: list[LocalBus] = []
        self.tokens: list[Presence] = []

    def bus(self, inbox: Inbox) -> LocalBus:
        """Returns a new bus on this network."""
        made = LocalBus(self, inbox)
        self.buses.append(made)
        return made


class LocalBus:
    """See `protocol.bus.Bus`."""

    def __init__(self, network: LocalNetwork, inbox: Inbox) -> None:
        self._network = network
        self._inbox = inbox
        self._asked: list[tuple[str, Topic]] = []
        self._watches = False
        self._tokens: list[Presence] = []
        self._sent_bytes = 0

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        """Delivers at once to every bus that asked."""
        key = TOPICS[topic_name].key(**parts)
        data = encode(message)
        self._sent_bytes += len(data)
        for bus in self._network.buses:
            bus.deliver(key, data)
        return len(data)

    def deliver(self, key: str, data: bytes) -> None:
        """Puts the bytes into the inbox if this bus asked for the key."""
        for pattern, topic in self._asked:
            if fnmatchcase(key, pattern):
                self._inbox.put(Sealed(topic, key, data, time.monotonic_ns()))

    def subscribe(self, topic_name: str, **parts: str) -> None:
        """See `Bus.subscribe`."""
        topic = TOPICS[topic_name]
        self._asked.append((topic.key(**parts), topic))

    def announce(self, role: str, process_id: str) -> None:
        """See `Bus.announce`."""
        token = Presence(role, process_id, alive=True, bus=self._network.name)
        self._tokens.append(token)
        self._network.tokens.append(token)
        self._tell(token)

    def watch(self) -> None:
        """See `Bus.watch`."""
        self._watches = True
        for token in self._network.tokens:
            self._inbox.put(token)

    def router(self) -> str:
        """See `Bus.router`."""
        return "local"

    def wire_bytes(self) -> int:
        """Returns the bytes published so far."""
        return self._sent_bytes

    def unsent_bytes(self) -> int:
        """Nothing waits here."""
        return 0

    def close(self) -> None:
        """Leaves the network."""
        self._network.buses.remove(self)
        for token in self._tokens:
            self._network.tokens.remove(token)
            self._tell(replace(token, alive=False))

    def _tell(self, presence: Presence) -> None:
        for bus in self._network.buses:
            if bus._watches:
                bus._inbox.put(presence)
