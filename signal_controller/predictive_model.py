"""Signal model of predictive control: movements by lane, phases, conflicts.

A movement leads from one incoming lane to one exit edge, over one or more links.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from protocol.approaches import Approaches
from protocol.roadmap import RoadMap, yellow_between
from signal_controller.observation import CabinetTimes, SignalSite

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

STEP_S = 1.0
"""The planner's step in time."""
RED, PERMITTED, PROTECTED = 0, 1, 2
_SPEED_MPS = 13.9  # of a lane that the map lacks


@dataclass(frozen=True, slots=True)
class Movement:
    """A movement from an incoming lane (its index) to the lanes of one exit edge."""

    lane: int
    exit_edge: str
    exit_lanes: tuple[str, ...]
    links: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Way:
    """Travel time from a lane's end to the stop bar at the speeds allowed, and the lane's speed."""

    end_m: float
    end_s: float
    speed_mps: float


class JunctionModel:
    """Tables of one signal; L lanes, M movements, P phases.

    Attributes:
        status: (P, M) of `RED`, `PERMITTED`, `PROTECTED`.
        lane_of: (M, L), 1 where a movement begins on a lane.
        foes: (P, L, F) lanes with right of way over a lane's permitted movements, -1 for none.
        change_steps: (P, P) from a green's end to the next green's begin.
        min_green_steps: (P,).
        reach_m: (L,) from where vehicles can be known to the stop bar: the map may end before.
        reach_s: (L,) how long they take from there, if nothing holds them.
    """

    def __init__(self, site: SignalSite, pedestrian_green_s: float) -> None:
        self.site = site
        self.phases = site.signal.greens
        intersection = site.road_map.by_tls[site.signal.tls]
        self.approaches = Approaches(site.road_map, intersection)
        self.lanes = intersection.incoming
        self.lane_index = {lane: index for index, lane in enumerate(self.lanes)}
        self.movements = _movements(site, self.lane_index)
        self.status = np.array(
            [[_status(state, m.links) for m in self.movements] for state in self.phases], np.int64
        )
        self.lane_of = np.zeros((len(self.movements), len(self.lanes)))
        for index, movement in enumerate(self.movements):
            self.lane_of[index, movement.lane] = 1.0
        self._ways = {lane: self._way(lane) for lane in self.approaches.upstream}
        self.reach_m, self.reach_s = np.array([self._reach(lane) for lane in self.lanes]).T
        self._in_the_way = self._find_in_the_way()
        self.foes = self._foes()
        self.change_steps = np.array(
            [[_change_steps(a, b, site.cabinet) for b in self.phases] for a in self.phases]
        )
        self.min_green_steps = self._min_green_steps(pedestrian_green_s)

    @cached_property
    def pair_status(self) -> Ints:
        """Statuses (P + P * P + 1, M): of phases, of what stays green from p to q, of nothing."""
        kept = np.minimum(self.status[:, None], self.status[None, :])
        for p, q in np.ndindex(*kept.shape[:2]):
            yellow = yellow_between(self.phases[p], self.phases[q])
            kept[p, q, [any(yellow[link] == "y" for link in m.links) for m in self.movements]] = RED
        nothing = np.zeros((1, len(self.movements)), np.int64)
        return np.concatenate([self.status, kept.reshape(-1, len(self.movements)), nothing])

    def phase_of(self, green: str) -> int:
        """Returns the phase that a green state is, or the plan's that is most like it."""
        if green in self.phases:
            return self.phases.index(green)
        planned = self.site.signal.planned_greens
        alike = [sum(a == b for a, b in zip(green, one, strict=False)) for one in planned]
        return alike.index(max(alike))

    def free_flow_s(self, lane: str, distance_m: float) -> float:
        """Returns how long a vehicle on a lane takes to the stop bar at the speeds allowed."""
        way = self._ways[lane]
        return way.end_s + max(0.0, distance_m - way.end_m) / way.speed_mps

    def _way(self, lane: str) -> _Way:
        """Follows the lanes from the end of one to the stop bar."""
        upstream, by_id = self.approaches.upstream, self.site.road_map.by_id
        length_m = by_id[lane].measured_m if lane in by_id else upstream[lane].start_m
        end_m = max(0.0, upstream[lane].start_m - length_m)
        end_s, at = 0.0, lane
        while at not in self.lane_index:
            ahead = [
                name
                for name in by_id[at].successors
                if name in upstream and upstream[name].counts_for == upstream[at].counts_for
            ]
            nearer = [name for name in ahead if upstream[name].start_m < upstream[at].start_m]
            if not nearer:
                break
            at = max(nearer, key=lambda name: upstream[name].start_m)
            end_s += by_id[at].measured_m / _speed_mps(self.site.road_map, at)
        return _Way(end_m, end_s, _speed_mps(self.site.road_map, lane))

    def _reach(self, lane: str) -> tuple[float, float]:
        upstream = self.approaches.upstream
        starts_m = {name: a.start_m for name, a in upstream.items() if a.counts_for == lane}
        within = {n: m for n, m in starts_m.items() if self._ways[n].end_m <= self.site.upstream_m}
        if not within:
            return 0.0, 0.0
        farthest = max(within, key=lambda name: within[name])
        reach_m = min(self.site.upstream_m, within[farthest])
        return reach_m, self.free_flow_s(farthest, reach_m)

    def foe_shares(self, shares: Floats) -> Floats:
        """Returns the share (P, L, F) of the vehicles of `foes` that conflict with a lane.

        Args:
            shares: (M,) of each movement among the vehicles of its lane.
        """
        by_lane = (self._in_the_way * shares) @ self.lane_of
        found = np.take_along_axis(by_lane, np.maximum(self.foes, 0), axis=2)
        return np.asarray(np.where(self.foes >= 0, found, 0.0))

    def _find_in_the_way(self) -> Bools:
        """Returns whether a movement (P, L, M) has right of way over a lane's permitted ones."""
        by_link = {link: m for m, one in enumerate(self.movements) for link in one.links}
        found = np.zeros((len(self.phases), len(self.lanes), len(self.movements)), np.bool_)
        for a, b in self.site.signal.conflicts:
            for link, other in ((a, b), (b, a)):
                m, foe = by_link.get(link), by_link.get(other)
                if m is None or foe is None or self.movements[m].lane == self.movements[foe].lane:
                    continue
                yields = self.status[:, m] == PERMITTED
                found[:, self.movements[m].lane, foe] |= yields & (self.status[:, foe] == PROTECTED)
        return found

    def _foes(self) -> Ints:
        """Returns the lanes (P, L, F) of the movements that conflict with a lane."""
        is_foe = (self._in_the_way @ self.lane_of) > 0
        most = max(1, int(is_foe.sum(axis=2).max(initial=0)))
        first = np.argsort(~is_foe, axis=2, kind="stable")[:, :, :most]
        return np.where(np.take_along_axis(is_foe, first, axis=2), first, -1)

    def _min_green_steps(self, pedestrian_green_s: float) -> Ints:
        """A phase that shows green where no vehicle passes lets people walk."""
        links = {link.index for link in self.site.signal.links}
        seconds = [
            max(
                self.site.cabinet.min_green_s,
                pedestrian_green_s
                if any(c in "Gg" and index not in links for index, c in enumerate(state))
                else 0.0,
            )
            for state in self.phases
        ]
        return np.maximum(1, np.ceil(np.array(seconds) / STEP_S)).astype(np.int64)


def _movements(site: SignalSite, lane_index: dict[str, int]) -> list[Movement]:
    found: dict[tuple[int, str], list[tuple[str, int]]] = {}
    for link in site.signal.links:
        key = lane_index[link.from_lane], site.road_map.edge_of(link.to_lane)
        found.setdefault(key, []).append((link.to_lane, link.index))
    return [
        Movement(lane, edge, tuple(lane for lane, _ in links), tuple(link for _, link in links))
        for (lane, edge), links in found.items()
    ]


def _speed_mps(road_map: RoadMap, lane: str) -> float:
    known = road_map.by_id.get(lane)
    return max(1.0, known.speed_mps) if known is not None else _SPEED_MPS


def _status(state: str, links: tuple[int, ...]) -> int:
    shown = {state[link] for link in links}
    return PROTECTED if "G" in shown else PERMITTED if "g" in shown else RED


def _change_steps(before: str, after: str, times: CabinetTimes) -> int:
    change_s = times.yellow_s + times.all_red_s
    return int(np.ceil(change_s / STEP_S)) if "y" in yellow_between(before, after) else 0
