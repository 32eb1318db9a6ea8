"""Requests on their way to the cabinet, where links are virtual and take simulated time."""

from __future__ import annotations

from protocol.inbox import Envelope
from protocol.messages import SignalRequest


class Pending:
    """Keeps requests until their simulated time has come; the newest frame's is handed on."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, SignalRequest, Envelope]] = []
        self._newest_ns = -1
        self.overtaken = 0

    def add(self, envelope: Envelope, request: SignalRequest) -> None:
        """Takes a request; it is due `delay_sim_ns` after its frame's time."""
        due_ns = request.sim_time_ns + (request.delay_sim_ns or 0)
        self._waiting.append((due_ns, request, envelope))

    def take(self, now_ns: int) -> tuple[SignalRequest, Envelope] | None:
        """Returns what is due, once; what a newer frame's request has overtaken is counted."""
        due = [entry for entry in self._waiting if entry[0] <= now_ns]
        if not due:
            return None
        self._waiting = [entry for entry in self._waiting if entry[0] > now_ns]
        _, request, envelope = max(due, key=lambda entry: entry[1].sim_time_ns)
        is_news = request.sim_time_ns > self._newest_ns
        self.overtaken += len(due) - is_news
        if not is_news:
            return None
        self._newest_ns = request.sim_time_ns
        return request, envelope
