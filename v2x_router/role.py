"""The router role: its process hosts the V2X bus for as long as it runs."""

from __future__ import annotations

from protocol.inbox import Envelope, Presence
from protocol.instances import ROUTER
from protocol.process import Context


class RouterRole:
    """Announces the process; Zenoh's own threads route."""

    @classmethod
    def build(cls, context: Context) -> RouterRole:
        """Announces the role."""
        context.announce(ROUTER)
        return cls()

    def on(self, item: Envelope | Presence) -> None:
        """Ignores what arrives: nothing was subscribed."""

    def poll(self) -> None:
        """Has nothing to do."""

    def close(self) -> None:
        """Holds nothing of its own: the bus is closed with its process."""
