"""Live viewer: attaches to a run and draws it, at a rate that it can keep up with."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Protocol

from protocol import topics
from protocol.errors import MessageError, ProtocolError
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import End, Metrics
from protocol.observer import FrameBuffer
from protocol.topics import BusName
from protocol.wire import peek_frame_time
from viewer.scene import Moment, Picture, Scene
from viewer.stages import FrameLatency, Stages, slowest

ENDING = "lanes"
DRAWN = frozenset({"truth", "state", "request", "scan", "plan", "detections", ENDING})
"""Topics of which only messages that are drawn are decoded."""
READ_AT_ONCE = frozenset({"tick", "metrics", "clock", "end", ENDING})
TOPICS = DRAWN | READ_AT_ONCE
_WAITING = {"scan": 4, "truth": 4, "tick": 8, "detections": 4, "metrics": 64}
_INBOX_ITEMS, _INBOX_BYTES = 4096, 64 << 20
REST_S = 0.1
"""Pause between polls of the inbox: messages are handled in batches, for less work."""


class Shows(Protocol):
    """Interface of a drawing backend."""

    def picture(self, picture: Picture) -> None:
        """Draws a frame."""

    def latency(self, latency: FrameLatency) -> None:
        """Adds a frame's times to the plots."""


def modest_inbox() -> Inbox:
    """Returns an inbox in which newer messages replace older ones if the viewer is too slow."""
    inbox = Inbox(_INBOX_ITEMS, _INBOX_BYTES)
    for topic, waiting in _WAITING.items():
        inbox.limit(topic, waiting)
    return inbox


class Live:
    """Draws a run until it ends.

    A picture costs about as much as the edge's own decoding: `fps` is a cap.
    """

    def __init__(self, inbox: Inbox, scene: Scene, shows: Shows, fps: float) -> None:
        inbox.keep_encoded()
        self._inbox = inbox
        self._scene = scene
        self._shows = shows
        self._period_ns = round(1e9 / fps)
        self._frames = FrameBuffer(ENDING)
        scenario = scene.setup.scenario
        period_ns = round(float(scenario["frame_period_s"]) * 1e9)
        self._stages = Stages(period_ns, scenario["regions"])
        self._drawn_ns = -self._period_ns
        self.is_over = False
        self.drawn = 0

    @property
    def left_out(self) -> int:
        """Complete frames that were not drawn."""
        return self._frames.left_out

    def follow(self, stop: threading.Event) -> None:
        """Draws until the run ends or `stop` is set."""
        while not (self.is_over or stop.is_set()):
            if (item := self._inbox.get()) is not None:
                self._take(item)
            if self._frames.is_due:
                self._draw_when_due()
            if self._inbox.is_empty:
                stop.wait(REST_S)
        self._frames.finish()
        self._draw()

    def _take(self, item: Envelope | Presence) -> None:
        if isinstance(item, Presence):
            is_world = item.role == "sim" and item.bus is BusName.WORLD
            self.is_over |= is_world and not item.alive
            return
        try:
            self._read(item)
        except ProtocolError as error:
            self._inbox.refuse(item.topic, error)

    def _read(self, item: Envelope) -> None:
        """Buffers messages about a frame, and handles messages about the run at once."""
        frame = peek_frame_time(item.data, topics.TOPICS[item.topic].message).frame
        if item.topic in DRAWN and frame is not None:
            self._frames.take(item, frame)
        if item.topic not in READ_AT_ONCE:
            return
        message = item.message
        self.is_over |= isinstance(message, End)
        if isinstance(message, Metrics):
            self._scene.measured(message)
        with suppress(MessageError):  # a viewer that attaches later receives ends of earlier spans
            self._stages.take(message)
        if item.topic == "tick":
            shown = self._scene.regions.keys()
            for latency in self._stages.latencies():
                if here := {region: latency[region] for region in shown & latency.keys()}:
                    self._shows.latency(slowest(here))

    def _draw_when_due(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns - self._drawn_ns >= self._period_ns and self._draw():
            self._drawn_ns = now_ns

    def _draw(self) -> bool:
        frame = self._frames.next()
        if frame is None:
            return False
        picture = self._scene.picture(Moment.of(frame, self._scene.regions))
        if picture is None:
            return False
        self._shows.picture(picture)
        self.drawn += 1
        return True
