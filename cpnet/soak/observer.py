"""Listens to both buses of a run and keeps account of whether all is right."""

from __future__ import annotations

import time
from collections.abc import Callable

from cpnet.soak.health import Health
from protocol.bus import Endpoint
from protocol.inbox import Envelope
from protocol.messages import SignalRequest
from protocol.onlooker import Onlooker

TOPICS = ("tick", "lanes", "state", "request")


class Observer:
    """Keeps a `Health` up to date; a context manager. `asked` are the frames with a request."""

    def __init__(self, v2x: Endpoint, world: Endpoint, health: Health) -> None:
        """Connects.

        Raises:
            BusError: the buses are not there.
        """
        self.health = health
        self.asked: set[int] = set()
        self._onlooker = Onlooker(v2x, world, TOPICS)

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *details: object) -> None:
        self._onlooker.__exit__(*details)

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Takes what comes for so long, or until that holds; returns whether it held."""
        for item in self._onlooker.listen(seconds):
            if isinstance(item, Envelope) and isinstance(item.message, SignalRequest):
                self.asked.add(item.message.frame)
            self.health.hear(item, time.monotonic_ns())
            if until():
                return True
        return until()

    def is_right(self) -> bool:
        """Whether all is right now."""
        return self.health.right_since_ns is not None
