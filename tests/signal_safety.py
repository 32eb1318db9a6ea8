"""Safety check of signals from the states that they showed, independent of the cabinet.

States are known at sampled times. At each the state had been shown for one step, the grid on which
a signal changes; states between two samples that are farther apart are not known. Only what was
unsafe whatever was shown there is a violation: with a frame per step nothing is missed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from protocol.roadmap import Signal
from recording.run import Run
from recording.tables import PhaseRow
from sim_host.config import CabinetConfig, TrafficConfig

_RED, _YELLOW, _GREEN = "red", "yellow", "green"
_BETWEEN = {(_GREEN, _RED): _YELLOW, (_RED, _YELLOW): _GREEN}  # what must lie between two colours


def violations(
    shown: Iterable[tuple[int, str]], signal: Signal, config: CabinetConfig, step_s: float
) -> list[str]:
    """Returns each breach of the signal's rules, in the order of time.

    That is: right of way for two links that conflict, unless the plan shows just that or more; a
    green shorter than `min_green_s`; one that ends without yellow; a yellow shorter than
    `yellow_s`; less than `all_red_s` between the yellow of a link and the green of one that
    conflicts with it, or its own; one that had right of way and yields without a stop between.

    Args:
        shown: simulated time in ns and state, one character per link, at rising times.
        signal: with its conflicts and its plan.
        config: the times to be kept.
        step_s: the grid on which the signal may change.
    """
    monitor = SignalMonitor(signal, config, step_s)
    return [found for time_ns, state in shown for found in monitor.observe(time_ns, state)]


def violations_of(run: Run) -> list[str]:
    """Returns the same for each signal of a run, as its signal states have it.

    Raises:
        ConfigError: the folder is no whole run.
    """
    config = CabinetConfig.model_validate(run.scenario.get("cabinet", {}))
    traffic = TrafficConfig.model_validate(run.scenario.get("traffic", {}))
    signals, found = run.setup.road_map.by_tls, []
    rows = sorted(run.rows(PhaseRow), key=lambda row: row.tls)
    for tls, of_signal in groupby(rows, key=lambda row: row.tls):
        shown = [(row.sim_time_ns, row.state) for row in of_signal]
        breaches = violations(shown, signals[tls].signal, config, traffic.step_s)
        found += [f"{tls}: {violation}" for violation in breaches] if len(signals) > 1 else breaches
    return found


@dataclass(slots=True)
class _Link:
    """One link: its colour, the sample before that began, when it was last not red."""

    colour: str
    began_ns: int | None = None
    lit: str = ""
    lit_ns: int = 0


class SignalMonitor:
    """Checks the states of one signal one after the other; see `violations`."""

    def __init__(self, signal: Signal, config: CabinetConfig, step_s: float) -> None:
        self._signal = signal
        self._step_ns = _ns(step_s)
        self._least_ns = {
            _GREEN: max(self._step_ns, _ns(config.min_green_s)),
            _YELLOW: _ns(config.yellow_s),
        }
        self._clearance_ns = {
            _GREEN: _ns(config.yellow_s) + _ns(config.all_red_s),
            _YELLOW: _ns(config.all_red_s),
        }
        self._foes = _conflicting_links(signal)
        self._size = len(signal.plan[0].state)
        self._links: list[_Link] = []
        self._state = ""
        self._time_ns = 0
        self._known: dict[str, list[str]] = {}

    def observe(self, time_ns: int, state: str) -> list[str]:
        """Takes the state shown at a time; returns its violations."""
        if state == self._state and time_ns > self._time_ns:
            self._time_ns = time_ns
            return []
        if len(state) != self._size:
            return [self._message(time_ns, f"{state!r} has not one character for each link")]
        if self._links and time_ns <= self._time_ns:
            return [self._message(time_ns, f"time does not increase from {self._time_ns} ns")]
        found = self._conflicts(state)
        colours = [_colour(letter) for letter in state]
        if self._links:
            found += self._changes(time_ns, colours) + self._yielding(time_ns, state)
        else:
            self._links = [_Link(colour) for colour in colours]
        self._state, self._time_ns = state, time_ns
        return [self._message(time_ns, one) for one in found]

    def _message(self, time_ns: int, what: str) -> str:
        return f"signal {self._signal.tls} at {time_ns / 1e9:g} s: {what}"

    def _conflicts(self, state: str) -> list[str]:
        if state not in self._known:
            self._known[state] = [
                f"{state}: links {a} and {b} conflict and both have right of way"
                for a, b in self._signal.conflicts
                if _colour(state[a]) == _colour(state[b]) == _GREEN
                and not self._is_planned(a, b, state)
            ]
        return self._known[state]

    def _is_planned(self, a: int, b: int, state: str) -> bool:
        """Whether the plan shows both green at once, with as much right of way or more."""
        return state[a] + state[b] != "GG" and any(
            all(_colour(green[k]) == _GREEN and green[k] <= state[k] for k in (a, b))
            for green in self._signal.planned_greens  # "G" comes before "g"
        )

    def _changes(self, time_ns: int, colours: list[str]) -> list[str]:
        hidden_ns = time_ns - self._step_ns - self._time_ns
        found: list[str] = []
        gaining: list[int] = []
        for number, (link, colour) in enumerate(zip(self._links, colours, strict=True)):
            if colour == link.colour:
                continue
            found += self._ended(number, link, colour, hidden_ns)
            if link.colour != _RED:
                link.lit, link.lit_ns = link.colour, self._time_ns
            link.colour, link.began_ns = colour, self._time_ns
            gaining += [number] if colour == _GREEN else []
        return found + [one for link in gaining for one in self._cleared(link, time_ns)]

    def _yielding(self, time_ns: int, state: str) -> list[str]:
        """Returns who had right of way and now yields, without a stop between."""
        hidden_ns = time_ns - self._step_ns - self._time_ns
        if hidden_ns >= self._clearance_ns[_GREEN]:
            return []
        return [
            f"link {link} had right of way and has to yield without yellow"
            for link, (before, after) in enumerate(zip(self._state, state, strict=True))
            if before + after == "Gg"
        ]

    def _ended(self, number: int, link: _Link, after: str, hidden_ns: int) -> list[str]:
        """Returns what is certainly wrong with the end of a link's colour."""
        before, found = link.colour, []
        if before != _RED and link.began_ns is not None:
            longest_ns = self._time_ns + hidden_ns - link.began_ns
            if longest_ns < self._least_ns[before]:
                found.append(f"link {number} was {before} for {longest_ns / 1e9:g} s at most")
        between = _BETWEEN.get((before, after))
        if between is not None and hidden_ns < self._least_ns[between]:
            found.append(f"link {number} went from {before} to {after} without {between}")
        return found

    def _cleared(self, gaining: int, time_ns: int) -> list[str]:
        """Returns which links lost their green too short a while before one gained its own."""
        found = []
        for foe in self._foes[gaining]:
            link = self._links[foe]
            if foe != gaining and link.colour == _GREEN:
                continue  # both at once: a conflict, or as the plan has it
            now_yellow = link.colour == _YELLOW
            lit, lit_ns = (_YELLOW, time_ns) if now_yellow else (link.lit, link.lit_ns)
            passed_ns = time_ns - self._step_ns - lit_ns
            if lit and passed_ns < self._clearance_ns[lit]:
                found.append(
                    f"link {gaining} turned green {max(0, passed_ns) / 1e9:g} s after link {foe} "
                    f"was {lit}, {self._clearance_ns[lit] / 1e9:g} s are needed"
                )
        return found


def _conflicting_links(signal: Signal) -> dict[int, list[int]]:
    """Returns for each link those that conflict with it, and itself."""
    foes = {number: [number] for number in range(len(signal.plan[0].state))}
    for a, b in signal.conflicts:
        foes[a].append(b)
        foes[b].append(a)
    return foes


def _colour(letter: str) -> str:
    return {"g": _GREEN, "G": _GREEN, "y": _YELLOW, "Y": _YELLOW}.get(letter, _RED)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
