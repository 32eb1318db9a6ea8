"""Policies: from counts and time to the green state to ask for. Pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from protocol.messages import LaneCounts, SignalState
from protocol.roadmap import Signal
from signal_controller.reckoning import Lanes, Weight, completed, weighed

Unseen = Literal["alike", "empty"]


@dataclass(frozen=True, slots=True)
class Decision:
    """A green state, one character per link, and the pressure of each of the signal's phases.

    `policy` is what decided; `unknown` are lanes whose vehicles were reckoned, not counted.
    """

    state: str
    pressures: list[float]
    policy: str
    unknown: tuple[str, ...] = ()


def max_pressure(
    signal: Signal,
    counts: LaneCounts,
    shown: SignalState | None,
    weight: Weight = "vehicles",
    unseen: Unseen = "empty",
    reckoned: Lanes | None = None,
) -> Decision:
    """Chooses the phase of highest pressure (Varaiya 2013; Chen et al. 2022).

    A tie leaves the present green, else the plan's first phase wins. While a change is under way
    its goal stands: the counts that led to it are not weighed anew half-way. Before the stop bar,
    what is `reckoned` of a lane stands in the place of its count.
    """
    greens = signal.greens
    before, behind = weighed(counts, weight)
    if unseen == "alike":
        before = completed(before, counts.seen_upstream)
        behind = completed(behind, counts.seen_downstream)
    reckoned = reckoned or {}
    before = {**before, **reckoned}
    pressures = [pressure(signal, green, before, behind) for green in greens]
    state = _chosen(greens, pressures, shown)
    return Decision(state, pressures, "max_pressure", tuple(reckoned))


def fixed(signal: Signal, sim_time_ns: int) -> Decision:
    """Asks for what the net's own plan shows at this time."""
    return Decision(signal.planned_green(sim_time_ns / 1e9), [], "fixed")


def blind(signal: Signal, sim_time_ns: int, unknown: Iterable[str]) -> Decision:
    """Asks for the same because nothing is known of any lane before the stop bar."""
    return Decision(signal.planned_green(sim_time_ns / 1e9), [], "plan", tuple(unknown))


def _chosen(greens: list[str], pressures: list[float], shown: SignalState | None) -> str:
    present = shown.green if shown is not None and shown.green in greens else None
    if shown is not None and present is not None and shown.stage != "green":
        return present
    highest = max(pressures)
    if present is not None and pressures[greens.index(present)] == highest:
        return present
    return greens[pressures.index(highest)]


def pressure(
    signal: Signal, green: str, upstream: Mapping[str, float], downstream: Mapping[str, float]
) -> float:
    """Returns vehicles before minus vehicles behind, over the lanes that a phase lets go.

    A lane counts once, however many ways it leads; what lies behind it is the mean over the exits
    that this phase opens to it. A lane without a count has none.
    """
    exits: dict[str, list[str]] = {}
    for link in signal.links:
        if green[link.index] in "Gg":
            exits.setdefault(link.from_lane, []).append(link.to_lane)
    return sum(
        upstream.get(lane, 0) - sum(downstream.get(name, 0) for name in names) / len(names)
        for lane, names in exits.items()
    )
