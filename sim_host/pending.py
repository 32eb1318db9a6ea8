"""Requests on their way to the cabinet, where links are virtual and take simulated time."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Callable
from dataclasses import dataclass

from protocol.inbox import Envelope
from protocol.messages import SignalRequest

MOST_WAITING = 512  # the longest deadline, 10 s, at 0.1 s a frame, has 100


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A request, and the simulated time from which on it may act."""

    due_ns: int
    request: SignalRequest
    envelope: Envelope


class Pending:
    """Keeps requests until their simulated time has come; of those due, the newest frame's acts.

    `overtaken` counts those that came behind a newer one that acted, `crowded_out` those that were
    let go because too many waited: the farthest from being due went first.
    """

    def __init__(self) -> None:
        self._waiting: list[Waiting] = []  # by due time, then as they came
        self.overtaken = 0
        self.crowded_out = 0

    def add(self, envelope: Envelope, request: SignalRequest) -> None:
        """Takes a request; it is due `delay_sim_ns` after its frame's time."""
        due_ns = request.sim_time_ns + (request.delay_sim_ns or 0)
        insort(self._waiting, Waiting(due_ns, request, envelope), key=_due_ns)
        if len(self._waiting) > MOST_WAITING:
            self._waiting.pop()
            self.crowded_out += 1

    def take(self, now_ns: int, accepts: Callable[[SignalRequest], bool]) -> Waiting | None:
        """Returns the newest of what is due that is accepted, if any; what is due is let go.

        One that is refused stands in nobody's way: the next newest is asked about.
        """
        split = bisect_right(self._waiting, now_ns, key=_due_ns)
        due, self._waiting = self._waiting[:split], self._waiting[split:]
        due.sort(key=lambda one: one.request.sim_time_ns, reverse=True)
        for place, one in enumerate(due):
            if accepts(one.request):
                self.overtaken += len(due) - place - 1
                self._pass(one.request.sim_time_ns)
                return one
        return None

    def _pass(self, sim_time_ns: int) -> None:
        """Lets go what is not due yet and already overtaken."""
        newer = [one for one in self._waiting if one.request.sim_time_ns > sim_time_ns]
        self.overtaken += len(self._waiting) - len(newer)
        self._waiting = newer


def _due_ns(one: Waiting) -> int:
    return one.due_ns
