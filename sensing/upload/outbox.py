"""Sends the chunks of the newest frame one after the other, as fast as the uplink takes them.

A thread per agent, so that a slow uplink is in nobody's way. The next chunk goes out when the
edge's estimate of the uplink's rate says that those before it have left, so that no more than about
one chunk ever queues below; it does not go out at all once a newer frame is there or the edge has
had enough. A slow uplink thus sends fewer chunks of each frame, then fewer frames, each of them
young.
"""

from __future__ import annotations

import threading
import time
from typing import Protocol

from protocol.errors import CpnetError

EARLY_NS = 4_000_000  # a chunk may queue so long, lest the uplink runs dry
LONGEST_NS = 1_000_000_000  # a rate that was wrong is tried again after this


class Shipment(Protocol):
    """A frame's chunks."""

    @property
    def frame(self) -> int:
        """The frame's number."""

    @property
    def chunks(self) -> int:
        """How many chunks there are to be sent."""

    def send(self, chunk: int) -> int:
        """Sends a chunk; returns its size in bytes."""


class Outbox:
    """Belongs to one agent. `unsent` counts the chunks that a newer frame made useless."""

    def __init__(self, agent: str) -> None:
        self._turn = threading.Condition()
        self._next: Shipment | None = None
        self._enough = -1
        self._mbps = 0.0
        self._free_ns = 0
        self._closed = False
        self._error: CpnetError | None = None
        self._done: list[Shipment] = []
        self.unsent = 0
        self._thread = threading.Thread(target=self._run, name=f"outbox {agent}", daemon=True)
        self._thread.start()

    def put(self, shipment: Shipment) -> None:
        """Takes the newest frame, in the place of what was not sent of the frame before.

        Raises:
            CpnetError: what the last frame failed with.
        """
        with self._turn:
            if self._error is not None:
                raise self._error
            if self._next is not None:
                self.unsent += self._next.chunks
            self._next = shipment
            self._turn.notify()

    def hear(self, *, enough: int, mbps: float) -> None:
        """Takes note of which frames need no more chunks, and of the rate, 0 if it is unknown."""
        with self._turn:
            self._enough, self._mbps = max(enough, self._enough), mbps
            self._turn.notify()

    def take_done(self) -> list[Shipment]:
        """Returns the frames of which nothing more will be sent, once."""
        with self._turn:
            done, self._done = self._done, []
        return done

    def close(self) -> None:
        """Sends nothing more; waits a second for a chunk that is on its way."""
        with self._turn:
            self._closed = True
            self._turn.notify()
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            while (shipment := self._take()) is not None:
                self._ship(shipment)
                with self._turn:
                    self._done.append(shipment)
        except CpnetError as error:
            with self._turn:
                self._error = error

    def _take(self) -> Shipment | None:
        with self._turn:
            self._turn.wait_for(lambda: self._closed or self._next is not None)
            shipment, self._next = self._next, None
            return None if self._closed else shipment

    def _ship(self, shipment: Shipment) -> None:
        for chunk in range(shipment.chunks):
            if not self._wait_for_turn(shipment.frame):
                with self._turn:
                    left_behind = self._next is not None and self._enough < shipment.frame
                    self.unsent += (shipment.chunks - chunk) * left_behind
                return
            size_bytes = shipment.send(chunk)
            with self._turn:
                took_ns = round(size_bytes * 8e3 / self._mbps) if self._mbps else 0
                begun_ns = max(self._free_ns, time.monotonic_ns())
                self._free_ns = begun_ns + min(took_ns, LONGEST_NS)

    def _wait_for_turn(self, frame: int) -> bool:
        """Waits until the uplink takes a chunk of a frame; False if it is no longer wanted."""
        with self._turn:
            while not (self._closed or self._next is not None or self._enough >= frame):
                wait_ns = self._free_ns - EARLY_NS - time.monotonic_ns()
                if wait_ns <= 0:
                    return True
                self._turn.wait(wait_ns / 1e9)
        return False
