"""Presence of processes: readiness before frame 0, and which process plays which vehicle."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Mapping

from protocol.errors import BusError
from protocol.inbox import Presence
from protocol.messages import Equipment
from protocol.topics import BusName
from sim_host.limits import MAX_PROCESSES

_LOG_PERIOD_NS = 5_000_000_000
_log = logging.getLogger(__name__)


class Readiness:
    """Readiness: which of the expected processes are present.

    A process is ready when it has announced itself on both buses: only then do both routers know
    all its subscriptions, so that it receives all of the first frame.
    """

    def __init__(self, expected: list[str], timeout_s: float) -> None:
        self._expected = expected
        self._timeout_s = timeout_s
        self._here: set[tuple[BusName, str]] = set()
        self._since_ns = self._reminded_ns = time.monotonic_ns()

    def note(self, presence: Presence) -> None:
        """Registers a presence; processes that are not expected are ignored."""
        if presence.id not in self._expected:
            return
        if presence.alive:
            self._here.add((presence.bus, presence.id))
        else:
            self._here.discard((presence.bus, presence.id))

    def is_on(self, bus: BusName, process_id: str) -> bool:
        """Whether a process is present on a bus."""
        return (bus, process_id) in self._here

    def is_complete(self) -> bool:
        """Whether all processes are ready; logs which ones are missing.

        Raises:
            BusError: a process did not appear in time; the message names it.
        """
        missing = ", ".join(
            name for name in self._expected if any((bus, name) not in self._here for bus in BusName)
        )
        now_ns = time.monotonic_ns()
        if missing and now_ns - self._since_ns > self._timeout_s * 1e9:
            raise BusError(
                f"{missing} did not appear within traffic.start_timeout_s, {self._timeout_s:g} s"
            )
        if missing and now_ns - self._reminded_ns > _LOG_PERIOD_NS:
            self._reminded_ns = now_ns
            _log.info("waiting for %s", missing)
        return not missing


class Fleet:
    """Assigns CAVs and CVs to the live vehicle processes, each kind by itself.

    A newcomer goes to the process that has the fewest of its kind, ties by process id; it stays
    there until it leaves or the process fails.
    """

    def __init__(self) -> None:
        self._live: set[str] = set()
        self._host_of: dict[str, str] = {}

    @property
    def processes(self) -> list[str]:
        """The live processes, sorted."""
        return sorted(self._live)

    def join(self, process: str) -> None:
        """Adds a vehicle process, unless there are too many; new vehicles go to it first."""
        if len(self._live) < MAX_PROCESSES:
            self._live.add(process)

    def leave(self, process: str) -> None:
        """Removes a vehicle process; its vehicles move at the next `assign`."""
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
