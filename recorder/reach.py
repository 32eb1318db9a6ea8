"""Whether the recorder could hear all that was said: a bus that loses its router says nothing."""

from __future__ import annotations

from protocol.bus import Bus
from protocol.topics import BusName
from recorder.tables import GapRow


class Reach:
    """Notes a gap whenever a bus's router was lost or was replaced by another.

    What was on its way then may have come to some and not to others.
    """

    def __init__(self, name: BusName, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._router = bus.router()
        self._since: int | None = None

    def look(self, last_whole: int) -> None:
        """Asks the bus; `last_whole` is the last frame of which there is all."""
        router = self._bus.router()
        if self._router and router != self._router and self._since is None:
            self._since = last_whole
        self._router = router or self._router

    def heard(self, bus: BusName, frame: int) -> GapRow | None:
        """Returns the gap that ends with a message of this frame, if one does."""
        if self._since is None or bus is not self._name or not self._bus.router():
            return None
        since, self._since = self._since, None
        return GapRow(since, self._name.value, frame)
