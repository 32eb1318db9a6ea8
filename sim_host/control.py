"""Who decides what the signal shows, as far as the role has to know."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from protocol.messages import SignalRequest, SignalState


class Cabinet(Protocol):
    """What decides in the end; see `SignalCabinet`."""

    refusals: Counter[str]

    def request(self, request: SignalRequest, now_ns: int) -> str | None:
        """Takes a wish; returns None, or why it was refused."""

    def refuse(self, request: SignalRequest, now_ns: int) -> str | None:
        """Returns why a wish could not be taken now, and counts that."""

    def advance(self, now_ns: int) -> str:
        """Returns the state to show from now until the next call."""

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Returns phase and timing."""
