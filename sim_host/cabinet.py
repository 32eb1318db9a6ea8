"""The signal cabinet: it accepts requests and shows only safe signal states.

A change from one green to another runs through yellow and all-red, which nothing cuts short.
Links that are green before and after it keep their green through it, as in real cabinets, unless
they are to yield from then on (`yellow_between`); so "all-red" holds for the links that lost their
green. While a change runs its goal is kept: a request that arrives meanwhile waits until the new
green has lasted its minimum.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from protocol.errors import ConfigError
from protocol.inbox import Envelope
from protocol.messages import SignalRequest, SignalState
from protocol.roadmap import Signal, yellow_between
from sim_host.config import CabinetConfig
from sim_host.limits import MAX_PENDING_REQUESTS


class Cabinet(Protocol):
    """Interface of a cabinet; see `SignalCabinet`."""

    refusals: Counter[str]

    def request(self, request: SignalRequest, now_ns: int) -> str | None:
        """Accepts a request and returns None, or returns why it was refused."""

    def refuse(self, request: SignalRequest, now_ns: int) -> str | None:
        """Returns why a request would be refused now, and counts that."""

    def advance(self, now_ns: int) -> str:
        """Returns the state to show from now until the next call."""

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Returns phase and timing."""


PLAN = "plan"


class SignalCabinet:
    """One signal. Times are simulated ns that never run backwards.

    Raises:
        ConfigError: the plan itself gives two conflicting links the right of way.
    """

    def __init__(self, signal: Signal, config: CabinetConfig) -> None:
        self._signal = signal
        self._size = len(signal.plan[0].state)
        self._shown = _shown_together(signal)
        self._durations_ns = {
            "green": max(1, _ns(config.min_green_s)),  # a green is shown before it ends
            "yellow": _ns(config.yellow_s),
            "all_red": _ns(config.all_red_s),
        }
        self._stale_ns = _ns(config.stale_after_s)
        self.refusals: Counter[str] = Counter()
        self._request: SignalRequest | None = None
        self._held: SignalRequest | None = None  # the last one that has begun, until this one does
        self._held_until_ns = 0
        self._stage = "all_red"
        self._since_ns: int | None = None
        self._state = self._green = "r" * self._size
        self._source = self._green_source = PLAN

    def request(self, request: SignalRequest, now_ns: int) -> str | None:
        """Accepts a request and returns None, or returns why it was refused.

        A refused request changes nothing: the last accepted one holds until it is stale. So does
        an accepted one until the time from which it is to be shown.
        """
        reason = self.refuse(request, now_ns)
        if reason is None:
            self._hold(request, now_ns)
            self._request = request
        return reason

    def refuse(self, request: SignalRequest, now_ns: int) -> str | None:
        """Returns why a request would be refused now, and counts that; None if it could."""
        reason = self._refusal(request, now_ns)
        if reason is not None:
            self.refusals[reason] += 1
        return reason

    def advance(self, now_ns: int) -> str:
        """Returns the state to show from now until the next call."""
        if self._since_ns is None:
            self._since_ns = now_ns
        wanted, self._source = self._wanted(now_ns)
        while now_ns - self._since_ns >= self._durations_ns[self._stage]:
            if self._stage == "green" and wanted == self._green:
                self._green_source = self._source
                break
            self._leave_stage(wanted)
            self._since_ns = now_ns
        return self._state

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Returns phase and timing; within a change, `green` is what it leads to."""
        since_ns = now_ns if self._since_ns is None else self._since_ns
        return SignalState(
            frame=frame,
            sim_time_ns=now_ns,
            tls=self._signal.tls,
            state=self._state,
            stage=self._stage,
            green=self._green,
            source=self._green_source,
            earliest_change_ns=max(now_ns, since_ns + self._durations_ns[self._stage]),
        )

    def _leave_stage(self, wanted: str) -> None:
        if self._stage == "green":
            yellow = yellow_between(self._state, wanted)
            self._stage = "yellow" if "y" in yellow else "green"
            self._state = yellow if "y" in yellow else wanted
            self._green, self._green_source = wanted, self._source
        elif self._stage == "yellow":
            self._stage = "all_red"
            self._state = self._state.replace("y", "r")
        else:
            if "g" not in self._green.lower():  # the first green after the start
                self._green, self._green_source = wanted, self._source
            self._stage = "green"
            self._state = self._green

    def _wanted(self, now_ns: int) -> tuple[str, str]:
        request, until_ns = self._request, self._held_until_ns
        if request is not None and request.not_before_ns <= now_ns:
            until_ns = request.sim_time_ns + self._stale_ns
        else:
            request = self._held
        if request is not None and now_ns <= until_ns:
            return request.state, request.policy
        return self._signal.planned_green(now_ns / 1e9), PLAN

    def _hold(self, request: SignalRequest, now_ns: int) -> None:
        """Keeps what is wanted until a request begins, unless it has not begun itself.

        It holds until then, if it is not stale now. Requests that replace the one put off do not
        prolong that.
        """
        last = self._request
        if last is None or last.not_before_ns > now_ns:
            return
        self._held, self._held_until_ns = last, last.sim_time_ns + self._stale_ns
        if now_ns <= self._held_until_ns:
            self._held_until_ns = max(self._held_until_ns, request.not_before_ns)

    def _refusal(self, request: SignalRequest, now_ns: int) -> str | None:
        # Age counts in simulated time, not in frames: a forged frame number must not lock others
        # out for ever.
        last = self._request
        checks = (
            ("wrong_tls", request.tls != self._signal.tls),
            ("wrong_length", len(request.state) != self._size),
            ("bad_alphabet", not set(request.state) <= set("rgG")),
            ("no_green", not set(request.state) & set("gG")),
            ("from_the_future", request.sim_time_ns > now_ns),
            ("stale", now_ns - request.sim_time_ns > self._stale_ns),
            ("begins_too_late", request.not_before_ns - request.sim_time_ns > self._stale_ns),
            ("replayed", last is not None and request.sim_time_ns <= last.sim_time_ns),
        )
        failed = next((reason for reason, bad in checks if bad), None)
        return failed or ("conflict" if self._conflicts(request.state) else None)

    def _conflicts(self, state: str) -> bool:
        return any(
            state[a] in "Gg" and state[b] in "Gg" and (a, b, state[a], state[b]) not in self._shown
            for a, b in self._signal.conflicts
        )


def _shown_together(signal: Signal) -> set[tuple[int, int, str, str]]:
    """Returns the states that the plan shows to conflicting links together, or with less right.

    The plan decides which of the two yields, so a `G` and a `g` may not be swapped.
    """
    shown: set[tuple[int, int, str, str]] = set()
    for green in signal.planned_greens:
        for a, b in signal.conflicts:
            one, other = green[a], green[b]
            if one == other == "G":
                raise ConfigError(
                    f"signal {signal.tls}: the plan's phase {green} gives G to links {a} and {b}, "
                    "which conflict; one of them must be g"
                )
            if one in "Gg" and other in "Gg":
                shown |= {(a, b, x, y) for x in {one, "g"} for y in {other, "g"}}
    return shown


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


SOURCE = "actuated"


@dataclass(frozen=True, slots=True)
class Interval:
    """One interval of a programme: a state, its least and its greatest duration."""

    state: str
    least_s: float
    most_s: float


def programme(signal: Signal, config: CabinetConfig) -> list[Interval]:
    """Returns the greens of the plan in its order, with the cabinet's times between them.

    A green continues while its loops detect vehicles, as the actuated programs of SUMO do.

    Raises:
        ConfigError: there is only one green.
    """
    greens = signal.planned_greens
    if len(greens) < 2:
        raise ConfigError(
            f"cabinet.control is actuated, but signal {signal.tls} has one green only"
        )
    intervals = []
    for green, after in zip(greens, greens[1:] + greens[:1], strict=True):
        losing = yellow_between(green, after)
        intervals.append(Interval(green, config.min_green_s, config.max_green_s))
        intervals.append(Interval(losing, config.yellow_s, config.yellow_s))
        if config.all_red_s:
            red = losing.replace("y", "r")
            intervals.append(Interval(red, config.all_red_s, config.all_red_s))
    return intervals


def loop_parameters(config: CabinetConfig) -> dict[str, str]:
    """Returns the parameters of the loops of SUMO's actuated control, by SUMO's names."""
    return {"max-gap": f"{config.max_gap_s:g}", "detector-gap": f"{config.detector_gap_s:g}"}


class ActuatedCabinet:
    """SUMO's own actuated control in the place of `SignalCabinet`; requests have no effect."""

    def __init__(self, signal: Signal, shown: Callable[[], str]) -> None:
        self._signal = signal
        self._shown = shown
        self._green = signal.planned_greens[0]
        self.refusals: Counter[str] = Counter()

    def request(self, request: SignalRequest, now_ns: int) -> str | None:  # noqa: ARG002 - see `SignalCabinet.request`
        """Ignores a request."""
        return None

    def refuse(self, request: SignalRequest, now_ns: int) -> str | None:  # noqa: ARG002 - see `SignalCabinet.refuse`
        """Never refuses a request."""
        return None

    def advance(self, now_ns: int) -> str:  # noqa: ARG002 - see `SignalCabinet.advance`
        """Returns what SUMO shows."""
        state = self._shown()
        if state in self._signal.planned_greens:
            self._green = state
        return state

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Returns phase and timing; the time of the next change is unknown."""
        state, greens = self.advance(now_ns), self._signal.planned_greens
        stage = "yellow" if "y" in state else "green" if state in greens else "all_red"
        after = greens[(greens.index(self._green) + 1) % len(greens)]
        return SignalState(
            frame=frame,
            sim_time_ns=now_ns,
            tls=self._signal.tls,
            state=state,
            stage=stage,
            green=self._green if stage == "green" else after,
            source=SOURCE,
            earliest_change_ns=now_ns,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PendingRequest:
    """A request, and the simulated time from which on it may act."""

    due_ns: int
    request: SignalRequest
    envelope: Envelope


class PendingRequests:
    """Requests in transit over virtual links, kept until they are due in simulated time.

    Of those due, the one of the newest frame acts. `overtaken` counts those that arrived behind a
    newer one that acted, `crowded_out` those dropped because too many were pending: the farthest
    from being due is dropped first.
    """

    def __init__(self) -> None:
        self._waiting: list[PendingRequest] = []  # by due time, then as they came
        self.overtaken = 0
        self.crowded_out = 0

    def add(self, envelope: Envelope, request: SignalRequest) -> None:
        """Takes a request; it is due `delay_sim_ns` after its frame's time."""
        due_ns = request.sim_time_ns + (request.delay_sim_ns or 0)
        insort(self._waiting, PendingRequest(due_ns, request, envelope), key=_due_ns)
        if len(self._waiting) > MAX_PENDING_REQUESTS:
            self._waiting.pop()
            self.crowded_out += 1

    def take(self, now_ns: int, accepts: Callable[[SignalRequest], bool]) -> PendingRequest | None:
        """Returns the newest due request that is accepted, if any, and drops all that are due.

        After one that is refused, the next newest is tried.
        """
        split = bisect_right(self._waiting, now_ns, key=_due_ns)
        due, self._waiting = self._waiting[:split], self._waiting[split:]
        due.sort(key=lambda one: one.request.sim_time_ns, reverse=True)
        for index, one in enumerate(due):
            if accepts(one.request):
                self.overtaken += len(due) - index - 1
                self._pass(one.request.sim_time_ns)
                return one
        return None

    def _pass(self, sim_time_ns: int) -> None:
        """Drops requests that are not due yet and already overtaken."""
        newer = [one for one in self._waiting if one.request.sim_time_ns > sim_time_ns]
        self.overtaken += len(self._waiting) - len(newer)
        self._waiting = newer


def _due_ns(one: PendingRequest) -> int:
    return one.due_ns
