"""The signal left to SUMO's own actuated control: loop detectors before the stop bars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from protocol.errors import ConfigError
from protocol.messages import SignalRequest, SignalState
from protocol.roadmap import Signal
from sim_host.config import CabinetConfig

SOURCE = "actuated"


@dataclass(frozen=True, slots=True)
class Interval:
    """One interval of the programme: a state, and how long it lasts at least and at most."""

    state: str
    least_s: float
    most_s: float


def programme(signal: Signal, config: CabinetConfig) -> list[Interval]:
    """Returns the greens of the plan in its order, with the cabinet's times between them.

    A green goes on while its loops see vehicles, as the actuated programs of SUMO do.

    Raises:
        ConfigError: there is only one green, and nothing to decide.
    """
    greens = signal.greens
    if len(greens) < 2:
        raise ConfigError(
            f"cabinet.control is actuated, but signal {signal.tls} has one green only"
        )
    intervals = []
    for green, after in zip(greens, greens[1:] + greens[:1], strict=True):
        losing = "".join(
            "y" if a in "Gg" and b not in "Gg" else a for a, b in zip(green, after, strict=True)
        )
        intervals.append(Interval(green, config.min_green_s, config.max_green_s))
        intervals.append(Interval(losing, config.yellow_s, config.yellow_s))
        if config.all_red_s:
            red = losing.replace("y", "r")
            intervals.append(Interval(red, config.all_red_s, config.all_red_s))
    return intervals


class ActuatedCabinet:
    """In the place of `SignalCabinet`: it shows what SUMO shows, and heeds no request."""

    def __init__(self, signal: Signal, shown: Callable[[], str]) -> None:
        self._signal = signal
        self._shown = shown
        self._green = signal.greens[0]
        self.refusals: Counter[str] = Counter()

    def request(self, request: SignalRequest, now_ns: int) -> str | None:  # noqa: ARG002 - see `SignalCabinet.request`
        """Takes note of a wish, which changes nothing."""
        return None

    def refuse(self, request: SignalRequest, now_ns: int) -> str | None:  # noqa: ARG002 - see `SignalCabinet.refuse`
        """Finds nothing wrong with a wish that changes nothing."""
        return None

    def advance(self, now_ns: int) -> str:  # noqa: ARG002 - see `SignalCabinet.advance`
        """Returns what is shown anyway."""
        state = self._shown()
        if state in self._signal.greens:
            self._green = state
        return state

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Returns phase and timing; when the next change comes, nobody knows beforehand."""
        state, greens = self.advance(now_ns), self._signal.greens
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
