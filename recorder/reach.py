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
        self._changed_ns = 0
        self._since: int | None = None

    def look(self, last_whole: int, now_ns: int) -> None:
        """Asks the bus, before each message is taken; `last_whole` is the last frame with all."""
        router = self._bus.router()
        if router == self._router:
            return
        if self._since is None:
            self._since = last_whole
        self._router, self._changed_ns = router, now_ns

    def heard(self, bus: BusName, frame: int, received_ns: int) -> GapRow | None:
        """Returns the gap that ends with a message of this frame, if one does.

        What came before the change was seen may have come through the router that is gone.
        """
        is_through = bus is self._name and self._router and received_ns > self._changed_ns
        if self._since is None or not is_through:
            return None
        since, self._since = self._since, None
        return GapRow(since, self._name.value, frame)


class Return:
    """The gap of a recorder that was away: it ends when something came again on both buses.

    What is heard must be of the topic that was asked for last on its bus: then all others are
    heard too.
    """

    def __init__(self, last_whole: int) -> None:
        self._last_whole = last_whole
        self._first: dict[BusName, int] = {}

    def heard(self, bus: BusName, frame: int) -> GapRow | None:
        """Returns the gap as it is known now, if this tells more of it."""
        if bus in self._first:
            return None
        self._first[bus] = frame
        return GapRow(self._last_whole, "recorder", max(self._first.values()))
