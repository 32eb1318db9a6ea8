"""Listens to both buses of a run, as a process of its own that disturbs nobody."""

from __future__ import annotations

import time
from collections.abc import Callable

from cpnet.soak.health import Health
from protocol.bus import Endpoint, open_bus
from protocol.inbox import Envelope, Inbox
from protocol.messages import SignalRequest
from protocol.topics import BusName

WORLD_TOPICS = ("tick",)
V2X_TOPICS = ("lanes", "state", "request")
POLL_S = 0.05


class Observer:
    """Keeps a `Health` up to date; a context manager. `asked` are the frames with a request."""

    def __init__(self, v2x: Endpoint, world: Endpoint, health: Health) -> None:
        """Connects.

        Raises:
            BusError: the buses are not there.
        """
        self.health = health
        self.asked: set[int] = set()
        self._inbox = Inbox()
        self._buses = [
            open_bus(name, endpoint, self._inbox)
            for name, endpoint in ((BusName.V2X, v2x), (BusName.WORLD, world))
        ]
        for bus, topics in zip(self._buses, (V2X_TOPICS, WORLD_TOPICS), strict=True):
            for topic in topics:
                bus.subscribe(topic)
            bus.watch()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        for bus in self._buses:
            bus.close()

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Takes what comes for so long, or until that holds; returns whether it held."""
        end_ns = time.monotonic_ns() + round(seconds * 1e9)
        while time.monotonic_ns() < end_ns:
            item = self._inbox.get(POLL_S)
            if item is None:
                continue
            if isinstance(item, Envelope) and isinstance(item.message, SignalRequest):
                self.asked.add(item.message.frame)
            self.health.hear(item, time.monotonic_ns())
            if until():
                return True
        return until()

    def is_right(self) -> bool:
        """Whether all is right now."""
        return self.health.right_since_ns is not None
