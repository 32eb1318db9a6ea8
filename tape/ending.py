"""When a tape is over: the world has ended, the recorder has heard all, and nobody speaks."""

from __future__ import annotations

from protocol.inbox import Presence
from protocol.topics import BusName

PATIENCE_NS = 4_000_000_000
SILENCE_NS = 150_000_000


class Ending:
    """The recorder knows when the last frame is whole: as long as it is there, more may come."""

    def __init__(self) -> None:
        self._ended_ns: int | None = None
        self._left_ns: int | None = None
        self._heard_ns = 0
        self._recorders: set[tuple[str, BusName]] = set()

    def look(self, presence: Presence, now_ns: int) -> None:
        """A process appeared or left; without a world nothing more is to come, until it is back.

        On the V2X bus all are gone for a moment when the edge dies, which hosts it.
        """
        if presence.role == "record":
            one = presence.id, presence.bus
            (self._recorders.add if presence.alive else self._recorders.discard)(one)
        elif presence.role == "sim" and presence.bus is BusName.WORLD:
            self._left_ns = None if presence.alive else now_ns

    def begin(self, now_ns: int) -> None:
        """The world stops."""
        self._ended_ns = now_ns if self._ended_ns is None else self._ended_ns

    def heard(self, now_ns: int) -> None:
        """Something was said."""
        self._heard_ns = now_ns

    def is_over(self, now_ns: int) -> bool:
        """Whether nothing more is to come, or patience has run out."""
        began_ns = self._left_ns if self._ended_ns is None else self._ended_ns
        if began_ns is None:
            return False
        is_silent = not self._recorders and now_ns - self._heard_ns >= SILENCE_NS
        return is_silent or now_ns - began_ns >= PATIENCE_NS
