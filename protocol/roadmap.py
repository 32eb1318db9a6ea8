"""Road map that all processes share: lanes, intersections, signals and their fixed plans."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cached_property
from typing import Annotated, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, FailFast, Field

MAP_RADIUS_M = 460.0
"""Distance to a signal within which a map has all lanes for road vehicles, m.

Farther than vehicles exist with the default of `traffic.radius_m`.
"""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


_P = TypeVar("_P", bound=_Part)


def _changed(part: _P, **values: object) -> _P:
    """Returns a part with other values, and nothing that was computed from the old ones."""
    return type(part)(**{name: getattr(part, name) for name in type(part).model_fields} | values)


class Lane(_Part):
    """One lane. The centreline runs in driving direction; points are x, y, z in the map frame.

    `tls` is the signal of the intersection that the lane belongs to: the one that it leads to
    first, or is part of, else the one that it leads away from.
    """

    id: str
    edge: str
    width_m: float
    speed_mps: float
    length_m: float
    centreline: Annotated[list[tuple[float, float, float]], FailFast()]
    successors: Annotated[list[str], FailFast()] = []
    internal: bool = False
    tls: str = ""

    @cached_property
    def points(self) -> npt.NDArray[np.float64]:
        """The centreline as (K, 3)."""
        return np.array(self.centreline, np.float64)

    @cached_property
    def bounds(self) -> npt.NDArray[np.float64]:
        """The least and the greatest x, y of the centreline (2, 2)."""
        return np.array([self.points[:, :2].min(axis=0), self.points[:, :2].max(axis=0)])

    @cached_property
    def measured_m(self) -> float:
        """Length of the centreline in the plane; `length_m` is what SUMO counts with."""
        return float(np.linalg.norm(np.diff(self.points[:, :2], axis=0), axis=1).sum())

    @property
    def measured_share(self) -> float:
        """Metres of the centreline for each of SUMO's: a net may state another length."""
        return self.measured_m / self.length_m if self.length_m > 0 else 1.0


def distance_m(points: npt.NDArray[np.float64], at: npt.NDArray[np.float64]) -> float:
    """Returns the distance of a point x, y (2,) from a polyline (K, 2 or 3), in the plane."""
    start, step = points[:-1, :2], np.diff(points[:, :2], axis=0)
    squared = np.maximum((step**2).sum(axis=1), 1e-12)
    along = np.clip(((at - start) * step).sum(axis=1) / squared, 0.0, 1.0)
    return float(np.linalg.norm(start + along[:, None] * step - at, axis=1).min())


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
        """Whether some link may go and none is being stopped (no yellow)."""
        return any(c in "Gg" for c in self.state) and "y" not in self.state


def yellow_between(before: str, after: str) -> str:
    """Returns what is yellow between two greens, `before` itself if their change stops nobody.

    Stopped are links that lose their green, and those that had right of way (`G`) and are to yield
    (`g`): whoever drives must not meet traffic that starts.
    """
    return "".join(
        "y" if (a in "Gg" and b not in "Gg") or a + b == "Gg" else a
        for a, b in zip(before, after, strict=True)
    )


class Signal(_Part):
    """A signal: its links, which of them conflict, and the plan that its net brings.

    `further_greens` are green states that policies may request beside those of the plan, see
    `sim_host.compatible_phases`.
    """

    tls: str
    links: Annotated[list[Link], FailFast()]
    conflicts: Annotated[list[tuple[int, int]], FailFast()]
    plan: Annotated[list[PlanPhase], FailFast()]
    offset_s: float = 0.0
    further_greens: Annotated[list[str], FailFast()] = []

    @property
    def planned_greens(self) -> list[str]:
        """The distinct green states of the plan, in its order."""
        return list(dict.fromkeys(phase.state for phase in self.plan if phase.is_green))

    @property
    def greens(self) -> list[str]:
        """The phases of the policies: those of the plan first."""
        return [*self.planned_greens, *self.further_greens]

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


class Intersection(_Part):
    """A signal and where it stands: the centre and the outline (x, y) of its junctions."""

    signal: Signal
    centre: tuple[float, float, float]
    outline: Annotated[list[tuple[float, float]], FailFast()]

    @property
    def tls(self) -> str:
        """Id of the signal."""
        return self.signal.tls

    @cached_property
    def incoming(self) -> list[str]:
        """Ids of the lanes that end at the stop bar, in link order."""
        return list(dict.fromkeys(link.from_lane for link in self.signal.links))

    @cached_property
    def outgoing(self) -> list[str]:
        """Ids of the lanes that begin behind the junction, in link order."""
        return list(dict.fromkeys(link.to_lane for link in self.signal.links))


class RoadMap(_Part):
    """Lanes and the intersections on them, of a net or a part of it, in the net's map frame."""

    name: str
    lanes: Annotated[list[Lane], FailFast()]
    intersections: Annotated[list[Intersection], FailFast()] = Field(min_length=1)

    @cached_property
    def by_id(self) -> dict[str, Lane]:
        """Lanes by their id."""
        return {lane.id: lane for lane in self.lanes}

    @cached_property
    def by_tls(self) -> dict[str, Intersection]:
        """Intersections by the id of their signal."""
        return {one.tls: one for one in self.intersections}

    @cached_property
    def centre(self) -> tuple[float, float, float]:
        """The mean of the intersections' centres."""
        x, y, z = np.mean([one.centre for one in self.intersections], axis=0).tolist()
        return x, y, z

    @cached_property
    def incoming(self) -> list[str]:
        """Ids of the lanes that end at a stop bar, by intersection, in link order."""
        return [lane for one in self.intersections for lane in one.incoming]

    @cached_property
    def predecessors(self) -> dict[str, list[str]]:
        """For each lane, the lanes that lead into it."""
        result: dict[str, list[str]] = {lane.id: [] for lane in self.lanes}
        for lane in self.lanes:
            for successor in lane.successors:
                if successor in result:
                    result[successor].append(lane.id)
        return result

    def edge_of(self, lane: str) -> str:
        """Returns the edge of a lane; a lane that the map lacks is an edge of its own."""
        known = self.by_id.get(lane)
        return known.edge if known is not None else lane

    def raised(self, by_m: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]) -> RoadMap:
        """Returns the map with other heights.

        Args:
            by_m: how much higher it is at places x, y (N, 2), as (N,) in m.
        """
        lanes = []
        for lane in self.lanes:
            points = lane.points.copy()
            points[:, 2] += by_m(points[:, :2])
            lanes.append(_changed(lane, centreline=[(x, y, z) for x, y, z in points.tolist()]))
        junctions = []
        for one in self.intersections:
            x, y, z = one.centre
            z += float(by_m(np.array([[x, y]]))[0])
            junctions.append(_changed(one, centre=(x, y, z)))
        return RoadMap(name=self.name, lanes=lanes, intersections=junctions)

    def part(self, lanes: Collection[str], junctions: Collection[str]) -> RoadMap:
        """Returns the map with these lanes and the intersections with these signals alone."""
        return RoadMap(
            name=self.name,
            lanes=[lane for lane in self.lanes if lane.id in lanes],
            intersections=[one for one in self.intersections if one.tls in junctions],
        )
