"""Which vehicle process plays which connected vehicle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from protocol.messages import Equipment

MAX_PROCESSES = 256


class Fleet:
    """Spreads CAVs and CVs over the live vehicle processes, each kind by itself.

    A newcomer goes to the process that has the fewest of its kind, ties by process id; it stays
    there until it leaves or the process dies.
    """

    def __init__(self) -> None:
        self._live: set[str] = set()
        self._host_of: dict[str, str] = {}

    @property
    def processes(self) -> list[str]:
        """The live processes, sorted."""
        return sorted(self._live)

    def join(self, process: str) -> None:
        """A vehicle process appeared; newcomers go to it until it has its share.

        Of too many processes no more get any.
        """
        if len(self._live) < MAX_PROCESSES:
            self._live.add(process)

    def leave(self, process: str) -> None:
        """A vehicle process vanished; its vehicles move at the next `assign`."""
        self._live.discard(process)

    def assign(self, equipment: Mapping[str, Equipment]) -> dict[str, str]:
        """Returns the process of each vehicle; empty while no process lives.

        Args:
            equipment: what every connected vehicle that is present carries, CAV or CV.
        """
        if not self._live:
            self._host_of = {}
            return {}
        kept = {
            vehicle: host
            for vehicle, host in self._host_of.items()
            if vehicle in equipment and host in self._live
        }
        load = Counter((equipment[vehicle], host) for vehicle, host in kept.items())
        for vehicle in sorted(equipment):
            if vehicle not in kept:
                kind = equipment[vehicle]
                host = min(self.processes, key=lambda process: (load[kind, process], process))
                load[kind, host] += 1
                kept[vehicle] = host
        self._host_of = kept
        return dict(kept)
