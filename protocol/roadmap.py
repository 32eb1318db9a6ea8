"""The road as every process knows it: lanes, the signal's links and its fixed plan."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, FailFast


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Lane(_Part):
    """One lane. The centreline runs in driving direction; points are x, y, z in the map frame."""

    id: str
    edge: str
    width_m: float
    speed_mps: float
    length_m: float
    centreline: Annotated[list[tuple[float, float, float]], FailFast()]
    successors: Annotated[list[str], FailFast()] = []
    internal: bool = False

    @cached_property
    def points(self) -> npt.NDArray[np.float64]:
        """The centreline as (K, 3)."""
        return np.array(self.centreline, np.float64)


class Link(_Part):
    """A movement over the stop bar: signal link `index` leads from one lane to another."""

    index: int
    from_lane: str
    to_lane: str


class PlanPhase(_Part):
    """A phase of the fixed plan; `state` holds one of `GgyrR...` per link, as in SUMO."""

    duration_s: float
    state: str

    @property
    def is_green(self) -> bool:
        """Whether somebody may go and nobody is being stopped."""
        return any(c in "Gg" for c in self.state) and "y" not in self.state


class Signal(_Part):
    """A signal: its links, which of them conflict, and the plan that its net brings."""

    tls: str
    links: Annotated[list[Link], FailFast()]
    conflicts: Annotated[list[tuple[int, int]], FailFast()]
    plan: Annotated[list[PlanPhase], FailFast()]
    offset_s: float = 0.0

    @property
    def greens(self) -> list[str]:
        """The distinct green states of the plan, in its order: the phases of the policies."""
        return list(dict.fromkeys(phase.state for phase in self.plan if phase.is_green))

    def planned_green(self, time_s: float) -> str:
        """Returns the plan's green at a time; within yellow or all-red, the green that follows."""
        cycle_s = sum(phase.duration_s for phase in self.plan)
        left_s = (time_s - self.offset_s) % cycle_s
        for index, phase in enumerate(self.plan):
            if left_s < phase.duration_s:
                order = self.plan[index:] + self.plan[:index]
                return next(p.state for p in order if p.is_green)
            left_s -= phase.duration_s
        return next(p.state for p in self.plan if p.is_green)


class RoadMap(_Part):
    """The lanes around one signal, in a map frame that is the net's."""

    name: str
    centre: tuple[float, float, float]
    lanes: Annotated[list[Lane], FailFast()]
    signal: Signal
    junction: Annotated[list[tuple[float, float]], FailFast()]

    @cached_property
    def by_id(self) -> dict[str, Lane]:
        """Lanes by their id."""
        return {lane.id: lane for lane in self.lanes}

    @cached_property
    def incoming(self) -> list[str]:
        """Ids of the lanes that end at the stop bar, in link order."""
        return list(dict.fromkeys(link.from_lane for link in self.signal.links))

    @cached_property
    def outgoing(self) -> list[str]:
        """Ids of the lanes that begin behind the junction, in link order."""
        return list(dict.fromkeys(link.to_lane for link in self.signal.links))

    @cached_property
    def predecessors(self) -> dict[str, list[str]]:
        """For each lane, the lanes that lead into it."""
        result: dict[str, list[str]] = {lane.id: [] for lane in self.lanes}
        for lane in self.lanes:
            for successor in lane.successors:
                if successor in result:
                    result[successor].append(lane.id)
        return result
