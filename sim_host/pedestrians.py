"""Pedestrian model: people walk along the pavements to a junction and cross its arms.

A kinematic model. People come to each crossing at random (exponential headways) and walk at a speed
of their own. They step onto a carriageway if the vehicles of the crossed arm have a red light while
others have a green one, if no vehicle comes straight on before they are over it, and if those that
turn can stop. Then drivers let them pass: those that can stop do so before the crossing, also those
whose light turns green meanwhile and those that turn (as the law has it, StVO, section 9). Between
the carriageways people wait as at a kerb.

Speeds: 15 % of people up to 60 years walk slower than 1.15 m/s (Fitzpatrick, Brewer and Turner
2006, Another Look at Pedestrian Walking Speed, Transportation Research Record 1982), which is a
deviation of 0.25 m/s below a mean of 1.4 m/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.geometry import Floats
from protocol.messages import PEDESTRIAN, Setup
from sensing.config import SceneConfig
from sensing.noise import stream
from sensing.road import RoadArea
from sim_host.config import TrafficConfig
from sim_host.crossings import HALF_WIDTH_M, Conflict, Crossing, Zone, crossings_of

PEDESTRIAN_TYPE = "DEFAULT_PEDTYPE"
"""SUMO's own type of people."""
_SPEED_MPS, _SPEED_STD_MPS, _SPEEDS_MPS = 1.4, 0.25, (0.8, 2.0)
_WAY_M = (15.0, 50.0)  # along the arm, before the crossing and behind it
_ASIDE_M = (0.5, 1.5)  # from the kerb, on the pavement
_BEHIND_PARKED_M = (2.6, 3.4)
_LOOK_S = 0.5  # a waiting person checks that often
_MARGIN_S = 1.0  # between a person that leaves a lane and a vehicle that comes
_ACCELERATION_MPS2 = 2.6  # SUMO's of cars; an approaching vehicle may speed up
_BRAKING_MPS2 = 3.0  # a vehicle that cannot stop with it does not let people pass
_BEFORE_M = 1.5  # that drivers stop before a crossing
_STEP_S = 0.2  # that they take until they brake
_STANDS_MPS = 0.1
_BODY_M = 0.3


@dataclass(slots=True)
class _Walker:
    """A walking person: a polyline (K, 2), whose corners lie `at_m` (K,) along it.

    `zones` are to be crossed, as begin, end, zone and whether it is walked from its end; the first
    of them `entered` or not.
    """

    id: str
    crossing: Crossing
    line: Floats
    at_m: Floats
    speed_mps: float
    zones: list[tuple[float, float, Zone, bool]]
    way_m: float = 0.0
    entered: bool = False
    looks_at_s: float = 0.0
    moves: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class People:
    """Ids, x, y and heading (N, 3) in m and rad, height above the ground (N,), speeds (N,)."""

    ids: list[str]
    plane: Floats
    above_m: Floats
    speeds_mps: Floats


class Pedestrians:
    """All people at the crossings of a map; the same seed and traffic give the same."""

    def __init__(self, setup: Setup, traffic: TrafficConfig, seed: int, sumo: Any) -> None:  # noqa: ANN401 - libsumo is untyped
        scenario = setup.scenario
        self._sumo = sumo
        self._seed = seed
        self._scene = SceneConfig.model_validate(scenario.get("scene", {}))
        self._aside_m = _BEHIND_PARKED_M if traffic.parked_per_100m else _ASIDE_M
        self._rate_hz = traffic.pedestrians_per_hour / 3600
        self._crossings = crossings_of(setup.road_map) if self._rate_hz else []
        self._area = RoadArea(setup.road_map) if self._rate_hz else None
        self._arrivals = [
            stream(seed, "pedestrians", one.tls, n) for n, one in enumerate(self._crossings)
        ]
        self._next_s = [self._headway_s(rng) for rng in self._arrivals]
        self._came = [0] * len(self._crossings)
        self._walkers: list[_Walker] = []
        self._held: set[str] = set()
        self._since_s: float | None = None

    def step(self, time_s: float) -> None:
        """Moves everybody on to a time of SUMO's."""
        if self._since_s is None:  # SUMO's clock may begin at any time of the day
            self._since_s = time_s
            self._next_s = [time_s + next_s for next_s in self._next_s]
        passed_s, self._since_s = time_s - self._since_s, time_s
        for n, crossing in enumerate(self._crossings):
            while self._next_s[n] <= time_s:
                self._next_s[n] += self._headway_s(self._arrivals[n])
                self._walkers.append(self._walker(n, crossing))
        traffic = _Oncoming(self._sumo)
        for one in self._walkers:
            self._walk(one, passed_s, time_s, traffic)
        self._hold(traffic)
        self._walkers = [one for one in self._walkers if one.way_m < one.at_m[-1]]

    def people(self) -> People:
        """Returns all people, by id."""
        found = sorted(self._walkers, key=lambda one: one.id)
        plane = np.array([_pose(one) for one in found]).reshape(-1, 3)
        above_m = np.zeros(len(found))
        if self._area is not None and found:
            aside_m = self._area.clearance_m(plane[:, :2], 10.0)
            on_pavement = (aside_m > 0) & (aside_m < self._scene.sidewalk_width_m)
            above_m[on_pavement] = self._scene.kerb_height_m
        speeds_mps = np.array([one.speed_mps * one.moves for one in found])
        return People([one.id for one in found], plane, above_m, speeds_mps)

    def _headway_s(self, rng: np.random.Generator) -> float:
        return float(rng.exponential(1 / self._rate_hz))

    def _walk(self, one: _Walker, passed_s: float, time_s: float, traffic: _Oncoming) -> None:
        way_m = one.way_m + one.speed_mps * passed_s
        if one.zones and not one.entered and way_m >= one.zones[0][0]:
            way_m = one.zones[0][0]
            if time_s >= one.looks_at_s:
                one.looks_at_s = time_s + _LOOK_S
                one.entered = self._may_enter(one, traffic)
        if one.entered and way_m >= one.zones[0][1]:
            del one.zones[0]
            one.entered, one.looks_at_s = False, time_s
        one.moves = way_m > one.way_m
        one.way_m = way_m

    def _may_enter(self, one: _Walker, traffic: _Oncoming) -> bool:
        begin_m, end_m, zone, is_turned = one.zones[0]
        for conflict in zone.conflicts:
            far_m = zone.end_m - conflict.begin_m if is_turned else conflict.end_m - zone.begin_m
            needed_s = min(far_m, end_m - begin_m) / one.speed_mps + _MARGIN_S
            if not traffic.leaves(one.crossing.tls, conflict, needed_s):
                return False
        return True

    def _hold(self, traffic: _Oncoming) -> None:
        """Stops vehicles before a crossing that someone is on, and releases all others."""
        wanted: set[str] = set()
        for one in self._walkers:
            if one.entered:
                for conflict in _ahead(one):
                    wanted |= traffic.stopping(conflict)
        api = self._sumo.vehicle
        for name in sorted(wanted - self._held):
            api.setSpeed(name, 0.0)
        gone = self._held - wanted
        for name in sorted(gone & set(api.getIDList()) if gone else gone):
            api.setSpeed(name, -1.0)
        self._held = wanted

    def _walker(self, number: int, crossing: Crossing) -> _Walker:
        """Draws someone who crosses an arm."""
        self._came[number] += 1
        name = f"{PEDESTRIAN}{number}.{self._came[number]}"
        rng = stream(self._seed, "pedestrian", name)
        is_turned = bool(rng.random() < 0.5)
        speed_mps = float(np.clip(rng.normal(_SPEED_MPS, _SPEED_STD_MPS), *_SPEEDS_MPS))
        shift = crossing.outward * rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M)
        come, go = (self._pavement(crossing, side, rng) for side in (0, 1))
        line = np.concatenate([come[::-1], crossing.ends + shift, go])
        at_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        start_m, total_m = float(at_m[len(come)]), float(at_m[-1])
        zones = [(start_m + z.begin_m, start_m + z.end_m, z, False) for z in crossing.zones]
        if is_turned:
            line, at_m = line[::-1], total_m - at_m[::-1]
            zones = [(total_m - end, total_m - begin, z, True) for begin, end, z, _ in zones[::-1]]
        return _Walker(name, crossing, line, at_m, speed_mps, zones)

    def _pavement(self, crossing: Crossing, side: int, rng: np.random.Generator) -> Floats:
        """Returns places (K, 2) on the pavement from a crossing's end outwards, as far as it is."""
        aside_m, way_m = rng.uniform(*self._aside_m), rng.uniform(*_WAY_M)
        kerb, aside = crossing.kerbs[side], crossing.aside[side]
        places = kerb + aside * aside_m
        along_m = (places - crossing.ends[side]) @ crossing.outward
        kept = places[(along_m > 2.0) & (along_m < way_m)]
        if self._area is None or not len(kept):
            return np.zeros((0, 2))
        blocked = np.flatnonzero(self._area.clearance_m(kept, 1.0) < min(aside_m, 0.5) / 2)
        return np.asarray(kept[: blocked[0]] if len(blocked) else kept)


def _pose(one: _Walker) -> tuple[float, float, float]:
    """Returns x, y and heading."""
    k = int(np.clip(np.searchsorted(one.at_m, one.way_m, side="right") - 1, 0, len(one.at_m) - 2))
    ahead = one.line[k + 1] - one.line[k]
    length_m = max(one.at_m[k + 1] - one.at_m[k], 1e-9)
    x, y = one.line[k] + ahead * (one.way_m - one.at_m[k]) / length_m
    return float(x), float(y), float(np.arctan2(ahead[1], ahead[0]))


def _ahead(one: _Walker) -> list[Conflict]:
    """Returns the conflicts of the zone that someone is in, but those behind."""
    begin_m, _, zone, is_turned = one.zones[0]
    walked_m = one.way_m - begin_m - _BODY_M
    if is_turned:
        return [c for c in zone.conflicts if c.begin_m < zone.end_m - walked_m]
    return [c for c in zone.conflicts if c.end_m > zone.begin_m + walked_m]


class _Oncoming:
    """The approaching traffic of one moment, read from SUMO on demand."""

    def __init__(self, sumo: Any) -> None:  # noqa: ANN401 - libsumo is untyped
        self._sumo = sumo
        self._states: dict[str, str] = {}
        self._lanes: dict[str, list[tuple[str, float, float, float]]] = {}

    def leaves(self, tls: str, conflict: Conflict, needed_s: float) -> bool:
        """Whether traffic leaves a person so much time to walk over a conflict."""
        state = self._state(tls)
        is_red = state[conflict.link] in "rRu"
        if conflict.is_own and not (is_red and any(c in "Gg" for c in state)):
            return False
        for lane, start_m, scale in conflict.lanes:
            for _, position_m, speed_mps, length_m in self._vehicles(lane):
                front_m = start_m + position_m * scale
                way_m = conflict.enter_m - front_m
                if front_m - length_m > conflict.leave_m:
                    continue
                if way_m <= 0:
                    return False
                waits = (is_red and front_m < 0) or conflict.is_turning
                if waits and _can_stop(way_m, speed_mps):
                    continue
                if _arrival_s(way_m, speed_mps) < needed_s:
                    return False
        return True

    def stopping(self, conflict: Conflict) -> set[str]:
        """Returns the vehicles that have to brake now to stop before a conflict."""
        found = set()
        for lane, start_m, scale in conflict.lanes:
            for name, position_m, speed_mps, _ in self._vehicles(lane):
                way_m = conflict.enter_m - start_m - position_m * scale
                if 0 < way_m < _BEFORE_M + speed_mps**2 / (2 * _BRAKING_MPS2) + speed_mps * _STEP_S:
                    found.add(name)
        return found

    def _state(self, tls: str) -> str:
        if tls not in self._states:
            self._states[tls] = str(self._sumo.trafficlight.getRedYellowGreenState(tls))
        return self._states[tls]

    def _vehicles(self, lane: str) -> list[tuple[str, float, float, float]]:
        """Returns id, position on the lane in m, speed in m/s and length in m of those on it."""
        if lane not in self._lanes:
            api = self._sumo.vehicle
            self._lanes[lane] = [
                (name, api.getLanePosition(name), api.getSpeed(name), api.getLength(name))
                for name in self._sumo.lane.getLastStepVehicleIDs(lane)
            ]
        return self._lanes[lane]


def _can_stop(way_m: float, speed_mps: float) -> bool:
    return speed_mps < _STANDS_MPS or speed_mps**2 < 2 * _BRAKING_MPS2 * (way_m - _BEFORE_M)


def _arrival_s(way_m: float, speed_mps: float) -> float:
    """Returns after what time a vehicle that speeds up is there."""
    root = np.sqrt(speed_mps**2 + 2 * _ACCELERATION_MPS2 * way_m)
    return float(root - speed_mps) / _ACCELERATION_MPS2
