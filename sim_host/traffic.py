"""What the sim role needs of a world, be it simulated or recorded."""

from __future__ import annotations

from typing import Protocol

from protocol.messages import Trip
from sim_host.world import Bodies, Counts


class Traffic(Protocol):
    """Moves in steps; see `sim_host.world.World`."""

    time_ns: int
    counts: Counts

    def step(self) -> None:
        """Goes on by one step."""

    def bodies(self) -> Bodies:
        """Returns where every vehicle within reach is."""

    def set_signal(self, state: str) -> None:
        """Shows a state at the signal."""

    def take_trips(self) -> list[Trip]:
        """Returns the journeys that ended since the last call."""

    def unfinished_trips(self) -> list[Trip]:
        """Returns the journeys still under way."""

    def waiting(self) -> int:
        """Returns how many find no room to enter."""

    def close(self) -> None:
        """Ends the world."""
