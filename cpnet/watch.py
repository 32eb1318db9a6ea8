"""The supervisor's subscriber of the world bus: progress, the end, presence."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

from cpnet.limits import MAX_BATCH, MAX_UNEXPECTED, MAX_WAITING_METRICS
from cpnet.processes import ProcessKey
from cpnet.scenario import Scenario
from protocol.bus import Endpoint, open_bus
from protocol.inbox import Envelope, Inbox, Presence
from protocol.instances import instances_of
from protocol.messages import End, Progress
from protocol.topics import BusName

if TYPE_CHECKING:
    from cpnet.metrics_page import RunMetrics  # prometheus_client: only runs with --metrics need it


def all_processes(scenario: Scenario) -> set[ProcessKey]:
    """Returns all processes that a scenario names, on whatever machine they run."""
    return {(one.role, one.id) for one in instances_of(scenario.model_dump(mode="json"))}


class PresenceTable:
    """Processes that are present, and expected ones that have left; others are forgotten."""

    def __init__(self, expected: Iterable[ProcessKey]) -> None:
        self._expected = frozenset(expected)
        self._unexpected = 0
        self.present: set[ProcessKey] = set()
        self.left: set[ProcessKey] = set()

    def update(self, presence: Presence) -> None:
        """Registers a process that joins or leaves; at most `MAX_UNEXPECTED` unexpected ones."""
        process = (presence.role, presence.id)
        if process in self._expected:
            (self.present.add if presence.alive else self.present.discard)(process)
            (self.left.discard if presence.alive else self.left.add)(process)
        elif presence.alive and process not in self.present and self._unexpected < MAX_UNEXPECTED:
            self.present.add(process)
            self._unexpected += 1
        elif not presence.alive and process in self.present:
            self.present.remove(process)
            self._unexpected -= 1


CONNECT_TIMEOUT_MS = 300
CLOSE_S = 1.0


class WorldWatch:
    """Subscribes to progress, end and presence on the world bus; a context manager."""

    def __init__(
        self, world: Endpoint, expected: Iterable[ProcessKey], metrics: RunMetrics | None = None
    ) -> None:
        """Connects; every message is also handed to `metrics`, if given.

        Raises:
            BusError: the world bus is not there yet.
        """
        self._inbox = Inbox()
        self._metrics = metrics
        self._bus = open_bus(BusName.WORLD, world, self._inbox, CONNECT_TIMEOUT_MS)
        self.progress: Progress | None = None
        self.end: End | None = None
        self._presence = PresenceTable(expected)
        for topic in ("progress", "end"):
            self._bus.subscribe(topic)
        if metrics is not None:
            self._inbox.limit("metrics", MAX_WAITING_METRICS)
            self._bus.subscribe("metrics")
        self._bus.watch()

    def __enter__(self) -> WorldWatch:
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnects without waiting for long: the world's router may have gone already."""
        closing = threading.Thread(target=self._bus.close, daemon=True)
        closing.start()
        closing.join(CLOSE_S)

    def update(self, timeout_s: float) -> bool:
        """Takes received messages, waiting at most this long; returns whether progress is new."""
        before = self.progress
        item = self._inbox.get(timeout_s)
        taken = 0
        while item is not None:
            self._take(item)
            taken += 1
            item = self._inbox.get() if taken < MAX_BATCH else None
        if self._metrics is not None:
            self._metrics.lost(self._inbox.drops)
        return self.progress is not before

    def await_end(self, timeout_s: float) -> None:
        """Takes messages until the run's end is received, waiting at most this long."""
        until_s = time.monotonic() + timeout_s
        while self.end is None and (left_s := until_s - time.monotonic()) > 0:
            self.update(left_s)

    def here(self, role: str) -> bool:
        """Whether a process of this role is present on any machine."""
        return any(present == role for present, _ in self._presence.present)

    def lost(self) -> list[ProcessKey]:
        """Returns role and id of the expected processes that have left."""
        return sorted(self._presence.left)

    def _take(self, item: Envelope | Presence) -> None:
        if self._metrics is not None:
            self._metrics.take(item)
        if isinstance(item, Presence):
            self._presence.update(item)
        elif isinstance(item.message, Progress):
            self.progress = item.message
        elif isinstance(item.message, End):
            self.end = item.message
