"""Who is on a bus, as far as a run has to know."""

from __future__ import annotations

from collections.abc import Iterable

from cpnet.scenario import Scenario
from protocol.inbox import Presence
from sim_host.presence import expected_processes

Who = tuple[str, str]
"""Role and id of a process."""

MAX_STRANGERS = 256  # anybody may invent tokens, where buses are not secured


def everybody(scenario: Scenario) -> set[Who]:
    """Returns all processes that a scenario names, on whatever machine they run."""
    ids = ["sim", *expected_processes(scenario.model_dump(mode="json"))]
    return {(name.rpartition("-")[0] or name, name) for name in ids}


class Crowd:
    """Those who are there, and those expected who have left; strangers are forgotten then."""

    def __init__(self, expected: Iterable[Who]) -> None:
        self._expected = frozenset(expected)
        self._strangers = 0
        self.present: set[Who] = set()
        self.left: set[Who] = set()

    def hear(self, presence: Presence) -> None:
        """Notes who came or went; of too many strangers no more are noted."""
        who = (presence.role, presence.id)
        if who in self._expected:
            (self.present.add if presence.alive else self.present.discard)(who)
            (self.left.discard if presence.alive else self.left.add)(who)
        elif presence.alive and who not in self.present and self._strangers < MAX_STRANGERS:
            self.present.add(who)
            self._strangers += 1
        elif not presence.alive and who in self.present:
            self.present.remove(who)
            self._strangers -= 1
