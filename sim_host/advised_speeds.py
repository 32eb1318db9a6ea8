"""Speed advice in the simulation: validated, kept until it is due, obeyed, ended.

The messages come over the network, so each is checked against the world: whether the agent exists,
is still before that signal, and whether the speed is allowed. A bad one is counted and dropped.
"""

from __future__ import annotations

import logging
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

from protocol.messages import SpeedAdvice
from sim_host.limits import MAX_PENDING_ADVICE

HELD_NS = 3_000_000_000  # for so long a vehicle drives by its last advice
_log = logging.getLogger(__name__)


class Drivers(Protocol):
    """Interface of vehicles that obey; see `World`."""

    def signals_ahead(self, agent: str) -> set[str] | None:
        """Returns the signals on an agent's route; None if there is no such agent."""

    def set_speed(self, agent: str, speed_mps: float | None) -> None:
        """Lets an agent drive at a speed, or freely."""


@dataclass(frozen=True, slots=True)
class SpeedBounds:
    """The speeds that may be advised."""

    least_mps: float
    most_mps: float

    def admit(self, speed_mps: float | None) -> bool:
        """Whether a speed may be advised; an end always may."""
        return speed_mps is None or self.least_mps <= speed_mps <= self.most_mps


@dataclass(frozen=True, slots=True)
class _Obeyed:
    tls: str
    sim_time_ns: int


class AdvisedSpeeds:
    """Receives speed advice and lets vehicles follow it.

    Due advice acts before a step of the world, in the order of its time, signal and agent, however
    it arrived. An agent drives as advised until the signal ends that, the stop bar is passed, or
    nothing new has come for `HELD_NS`; of two signals the later one counts. `obeyed` counts the
    advice that vehicles followed.
    """

    def __init__(
        self, drivers: Drivers, signals: Collection[str], bounds: SpeedBounds, *, lockstep: bool
    ) -> None:
        self._drivers = drivers
        self._signals = signals
        self._bounds = bounds
        self._lockstep = lockstep
        self._pending: list[SpeedAdvice] = []  # by due time, then as it is to act
        self._arrived: dict[str, set[str]] = {}  # agents by signal, of the present frame
        self._newest_ns: dict[tuple[str, str], int] = {}  # by signal and agent
        self._held: dict[str, _Obeyed] = {}
        self._refusals: Counter[str] = Counter()
        self.obeyed = 0

    def begin_frame(self) -> None:
        """Counts from 0 what has `arrived`."""
        self._arrived.clear()

    def arrived(self, tls: str) -> int:
        """Returns to how many agents a signal has sent advice in this frame, good or bad."""
        return len(self._arrived.get(tls, ()))

    def take(
        self, advice: SpeedAdvice, key: Mapping[str, str], now_ns: int, *, awaited: bool
    ) -> None:
        """Receives advice that came under a key; in lockstep only what is `awaited`."""
        if awaited and advice.tls in self._signals:
            self._arrived.setdefault(advice.tls, set()).add(advice.agent)
        reason = self._refusal(advice, key, now_ns, awaited=awaited)
        if reason is not None:
            self._refusals[reason] += 1
            if self._refusals[reason] == 1:
                _log.warning("advice for %r refused: %s (then only counted)", advice.agent, reason)
            return
        if self._drivers.signals_ahead(advice.agent) is None:
            return  # the end of advice to one that has left
        self._newest_ns[advice.tls, advice.agent] = advice.sim_time_ns
        insort(self._pending, advice, key=_order)
        if len(self._pending) > MAX_PENDING_ADVICE:
            self._pending.pop()
            self._refusals["crowded_out"] += 1

    def actuate(self, now_ns: int) -> None:
        """Lets vehicles follow due advice, and ends expired advice."""
        split = bisect_right(self._pending, now_ns, key=_due_ns)
        due, self._pending = self._pending[:split], self._pending[split:]
        for advice in sorted(due, key=_rank):
            self._obey(advice)
        for agent, obeyed in list(self._held.items()):
            is_over = now_ns - obeyed.sim_time_ns > HELD_NS
            if is_over or not self._is_before(agent, obeyed.tls):
                self._release(agent)
        self._forget(now_ns)

    def drops(self) -> Counter[str]:
        """Returns by reason how much advice had no effect."""
        return Counter({f"advice_{why}": n for why, n in self._refusals.items()})

    def _obey(self, advice: SpeedAdvice) -> None:
        agent, speed_mps = advice.agent, advice.speed_mps
        if speed_mps is None:
            if agent in self._held and self._held[agent].tls == advice.tls:
                self._release(agent)
        elif self._is_before(agent, advice.tls):
            self._drivers.set_speed(agent, speed_mps)
            self._held[agent] = _Obeyed(advice.tls, advice.sim_time_ns)
            self.obeyed += 1

    def _release(self, agent: str) -> None:
        del self._held[agent]
        if self._drivers.signals_ahead(agent) is not None:
            self._drivers.set_speed(agent, None)

    def _is_before(self, agent: str, tls: str) -> bool:
        return tls in (self._drivers.signals_ahead(agent) or ())

    def _forget(self, now_ns: int) -> None:
        """Forgets the newest times that are so old that nothing older would be accepted."""
        old = [one for one, taken_ns in self._newest_ns.items() if now_ns - taken_ns > HELD_NS]
        for one in old:
            del self._newest_ns[one]

    def _refusal(
        self, advice: SpeedAdvice, key: Mapping[str, str], now_ns: int, *, awaited: bool
    ) -> str | None:
        """Returns why advice is refused, None if it is not."""
        ahead, speed_mps = self._drivers.signals_ahead(advice.agent), advice.speed_mps
        is_end = speed_mps is None
        last_ns = self._newest_ns.get((advice.tls, advice.agent))
        checks = (
            ("wrong_key", (key.get("tls"), key.get("agent")) != (advice.tls, advice.agent)),
            ("wrong_tls", advice.tls not in self._signals),
            ("out_of_turn", self._lockstep and not awaited),
            ("from_the_future", advice.sim_time_ns > now_ns),
            ("stale", now_ns - advice.sim_time_ns > HELD_NS),
            ("replayed", last_ns is not None and advice.sim_time_ns <= last_ns),
            ("bad_speed", not self._bounds.admit(speed_mps)),
            ("unknown_agent", ahead is None and not is_end),
            ("passed", ahead is not None and advice.tls not in ahead and not is_end),
        )
        return next((reason for reason, bad in checks if bad), None)


def _due_ns(advice: SpeedAdvice) -> int:
    return advice.sim_time_ns + (advice.delay_sim_ns or 0)


def _rank(advice: SpeedAdvice) -> tuple[int, str, str]:
    return advice.sim_time_ns, advice.tls, advice.agent


def _order(advice: SpeedAdvice) -> tuple[int, tuple[int, str, str]]:
    return _due_ns(advice), _rank(advice)
