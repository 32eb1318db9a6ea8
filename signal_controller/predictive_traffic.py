"""Traffic model of predictive control: learns turning shares, headways, arrivals, wishes.

Everything is learnt from the vehicles that are given, by their ids; nothing from a simulator.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from signal_controller.exits import Exits
from signal_controller.observation import LaneVehicles
from signal_controller.parked_places import ParkedPlaces
from signal_controller.predictive_model import (
    PERMITTED,
    PROTECTED,
    RED,
    STEP_S,
    Floats,
    Ints,
    JunctionModel,
)
from signal_controller.tracked_vehicle import STOPPED_MPS, TrackedVehicle

_SLOW_MPS = 2.0  # a parked car's box wanders: a slower one may still be parked
_TURN_PRIOR = 2.0  # vehicles that an unseen share of turns is worth
_OWN_LANE_PRIOR, _OTHER_LANE_PRIOR = 12.0, 2.0  # the same of the lane that one will stop in
_RATE_WINDOW_S, _RATE_PRIOR_S = 600.0, 90.0
_HEADWAY_S, _LOST_S = (1.0, 4.0), (0.0, 6.0)  # samples outside are no discharge of a queue
_LEARNING = 0.05  # weight of a new sample
_HEAD_M = 10.0  # a vehicle so near the stop bar is the first
_REACTION_S = 3.0  # after which a first vehicle that may go has gone
_START_MPS = 4.0  # how fast the begin of green travels back along a queue
_PATIENCE_S = {PROTECTED: 1.5, PERMITTED: 15.0}  # how fast its probability to want that falls
_STUCK_PRIOR = 0.02  # that it wants nothing: a ghost, a parked car, a breakdown
_PARKED = 0.5  # it is taken for parked from such a probability on
_FORGIVEN_S = 120.0  # in which that probability recovers
_GREENS = (PROTECTED, PERMITTED)
_SHORT_M = 6.0  # on a shorter lane before a stop bar no middle of a vehicle may ever be seen
_ACCELERATION_MPS2 = 2.0
_LOST_AFTER_S = 2.0  # a vehicle unseen for so long is forgotten
_TURN_OFF_S = 1.5  # one that vanishes so near the end of its lane has turned off there


class TrafficMemory:
    """Learns from frame to frame.

    Attributes:
        headway_s: (L,) between vehicles of a discharging queue.
        lost_s: (L,) from a green's begin to the first vehicle at the stop bar.
        green_since_s: (M,) since when a movement has been green; inf while it is red.
        served_s: (M,) when a movement last had its chance, see `waiting_s`.
        has_room: (M,) whether its exit can take a vehicle.
        watched_lanes: those whose vehicles matter.
    """

    def __init__(self, model: JunctionModel, inflow_vph: float, saturation_vph: float) -> None:
        self._model = model
        lanes, movements = len(model.lanes), len(model.movements)
        self.headway_s = np.full(lanes, 3600 / saturation_vph)
        self.lost_s = np.full(lanes, 1.5)
        self.green_since_s = np.full(movements, math.inf)
        self.served_s = np.full(movements, math.nan)
        self.has_room = np.ones(movements, bool)
        self._of_lane = [np.flatnonzero(model.lane_of[:, lane]) for lane in range(lanes)]
        self._turns = np.full(movements, _TURN_PRIOR)
        self._choice: dict[str, Floats] = {}
        self._passed = np.zeros(lanes)
        self._watched_s = np.zeros(lanes)
        self._is_seen = np.zeros(lanes, np.bool_)
        self._inflow_per_s = inflow_vph / 3600
        self._last_passage_s = np.full(lanes, -math.inf)
        self._last_green_s = np.full(lanes, -math.inf)
        self._heads: list[Floats | None] = [None] * lanes  # what the first vehicles want
        self._first_waits = np.zeros(lanes, np.bool_)  # also farther from the stop bar
        self._tracks: dict[str, TrackedVehicle] = {}
        self._parked_places = ParkedPlaces()
        self._exits = Exits(model)
        self._ends_m = _lane_ends(model)
        self._bars = _bars(model, self._ends_m)
        planned = len(model.site.signal.planned_greens)
        self._has_protected = (model.status == PROTECTED).any(axis=0)
        self._is_planned_protected = (model.status[:planned] == PROTECTED).any(axis=0)
        self._time_s: float | None = None

        around = model.approaches
        self.watched_lanes = {
            *around.upstream,
            *around.downstream,
            *around.inside,
            *self._exits.starts_m,
        }

    @property
    def lane_green_since_s(self) -> Floats:
        """Since when any movement of a lane (L,) has been green; inf while all are red."""
        return np.array([np.min(self.green_since_s[own]) for own in self._of_lane])

    @property
    def shares(self) -> Floats:
        """Share of each movement (M,) among the vehicles of its lane."""
        total = self._model.lane_of @ (self._model.lane_of.T @ self._turns)
        return np.asarray(self._turns / total)

    @property
    def arrivals_per_s(self) -> Floats:
        """Vehicles that come on each lane (L,), of the last ten minutes in which it was seen."""
        prior = self._inflow_per_s * _RATE_PRIOR_S
        return np.asarray((self._passed + prior) / (self._watched_s + _RATE_PRIOR_S))

    def head_may_go(self, status: Ints) -> Floats:
        """Returns the probability (P, L) that a lane's first vehicle goes, by status (P, M)."""
        shares, result = self.shares, np.zeros((len(status), len(self._model.lanes)))
        for lane, own in enumerate(self._of_lane):
            wish = self._heads[lane]
            wanted = shares[own] if wish is None else wish[:-1]
            result[:, lane] = ((status[:, own] != RED) & self.has_room[own]) @ wanted
        return result

    @property
    def parked(self) -> set[str]:
        """Ids of stationary vehicles that did not go when they could: parked cars, ghosts."""
        return {name for name, track in self._tracks.items() if track.is_parked}

    def credit(self, time_s: float, open_s: Floats) -> Floats:
        """Returns the part of a vehicle that each lane (L,) could have served since its last one.

        That is the time since then, or `open_s` (L,) for which it has discharged if that is less,
        over its headway; and at most what leaves a step for the next vehicle.
        """
        idle_s = np.minimum(time_s - self._last_passage_s, open_s)
        most_s = np.maximum(self.headway_s - STEP_S, 0.0)
        return np.asarray(np.clip(idle_s, 0.0, most_s) / self.headway_s)

    def waiting_inside(self, time_s: float) -> Floats:
        """Returns 1 for each lane (L,) whose last vehicle stands behind the stop bar, else 0."""
        result = np.zeros(len(self._model.lanes))
        for track in self._tracks.values():
            stands = track.time_s == time_s and track.speed_mps < STOPPED_MPS
            if stands and track.passed >= 0 and track.lane in self._model.approaches.inside:
                result[track.passed] = 1.0
        return result

    def chosen_lanes(self, lane: str) -> Floats:
        """Returns the probability (L,) of each stop bar for a vehicle on a lane before them.

        They sum to less than 1 where vehicles turn off before.
        """
        counts = self._choices_of(lane)
        return np.asarray(counts[:-1] / counts.sum())

    def _choices_of(self, lane: str) -> Floats:
        """Returns how many vehicles chose each stop bar (L + 1,), the last none of them."""
        counts = self._choice.get(lane)
        if counts is None:
            target = self._model.approaches.upstream[lane].counts_for
            counts = np.zeros(len(self._model.lanes) + 1)
            is_own = lane in self._model.lane_index
            counts[self._model.lane_index[target]] = (
                _OWN_LANE_PRIOR if is_own else _OTHER_LANE_PRIOR
            )
            self._choice[lane] = counts
        return counts

    def arrival_s(self, distance_m: Floats, speed_mps: Floats, limit_mps: Floats) -> Floats:
        """Returns how long vehicles (N,) take to the stop bar if nothing holds them."""
        speed = np.minimum(speed_mps, limit_mps)
        gain_s = (limit_mps - speed) / _ACCELERATION_MPS2
        gain_m = (speed + limit_mps) / 2 * gain_s
        reaches = distance_m >= gain_m
        whole = gain_s + (distance_m - gain_m) / limit_mps
        root = np.sqrt(speed**2 + 2 * _ACCELERATION_MPS2 * np.maximum(distance_m, 0.0))
        return np.where(reaches, whole, (root - speed) / _ACCELERATION_MPS2)

    def take(
        self, time_s: float, vehicles: LaneVehicles, state: str, unseen: Collection[str] = ()
    ) -> None:
        """Learns from a frame's vehicles, with the state that the signal shows.

        On `unseen` lanes before the stop bars there may be others.
        """
        passed_s = 0.0 if self._time_s is None else max(0.0, min(10.0, time_s - self._time_s))
        self._time_s = time_s
        fading = math.exp(-passed_s / _RATE_WINDOW_S)
        self._is_seen = np.array([lane not in unseen for lane in self._model.lanes])
        self._watched_s = fading * self._watched_s + self._is_seen * _RATE_WINDOW_S * (1 - fading)
        self._passed *= fading
        self.served_s[np.isnan(self.served_s)] = time_s
        shown = self._note_signal(time_s, state)
        self.has_room = self._exits.room(vehicles, self._tracks)
        self._follow(time_s, vehicles)
        self._find_parked(time_s)
        self._forgive(passed_s)
        self._watch_heads(time_s, passed_s, shown)
        self._note_service(time_s, shown, unseen)

    def open_shares(self, state: str) -> Floats:
        """Returns which share of a lane may go, with right of way and yielding (L, 2)."""
        shown, lane_of = self._shown(state), self._model.lane_of
        parts = [np.where(shown == kind, self.shares, 0.0) @ lane_of for kind in _GREENS]
        return np.array(parts).T

    def _shown(self, state: str) -> Ints:
        """Returns the status of each movement (M,)."""
        return np.array(
            [
                max(
                    (PROTECTED if state[i : i + 1] == "G" else PERMITTED)
                    if state[i : i + 1] in ("G", "g")
                    else RED
                    for i in movement.links
                )
                for movement in self._model.movements
            ]
        )

    def _note_signal(self, time_s: float, state: str) -> Ints:
        shown = self._shown(state)
        fresh = (shown != RED) & np.isinf(self.green_since_s)
        self.green_since_s[fresh] = time_s
        self.green_since_s[shown == RED] = math.inf
        self._last_green_s[np.isfinite(self.lane_green_since_s)] = time_s
        return shown

    def _follow(self, time_s: float, vehicles: LaneVehicles) -> None:
        upstream = self._model.approaches.upstream
        rows = zip(
            vehicles.ids,
            vehicles.lanes,
            vehicles.distances_m.tolist(),
            vehicles.speeds_mps.tolist(),
            strict=True,
        )
        for name, lane, distance_m, speed_mps in rows:
            if not name:
                continue
            track = self._tracks.get(name)
            if track is None:
                track = self._tracks[name] = TrackedVehicle(lane, -1, distance_m, time_s)
            if lane in upstream:
                track.incoming = self._bars.get(lane, -1)
                track.passed = -1
                track.visited.add(lane)
                track.has_stopped |= speed_mps < STOPPED_MPS
            elif track.incoming >= 0:
                late_s = min(1.0, -distance_m / speed_mps) if speed_mps > 1 > distance_m else 0.0
                self._note_passage(track, time_s - max(0.0, late_s))
            if track.passed >= 0:
                self._note_exit(track, lane)
            track.move(lane, distance_m, time_s, speed_mps)
        self._exits.note_driven_past(time_s, self._tracks.values())
        self._forget_lost(time_s)

    def _forget_lost(self, time_s: float) -> None:
        """Forgets vehicles that were not seen for long, and notes what that says."""
        for name in [n for n, t in self._tracks.items() if time_s - t.time_s > _LOST_AFTER_S]:
            track = self._tracks.pop(name)
            if track.incoming >= 0 and track.distance_m < _HEAD_M:
                if self._may_have_passed(track):
                    self._note_passage(track, track.time_s)
            elif self._has_turned_off(track):
                self._note_choice(track, -1)

    def _may_have_passed(self, track: TrackedVehicle) -> bool:
        """Whether one that vanished at a stop bar had green or yellow then.

        One that vanished at red is still there: its track was lost, or goes on under another id. So
        is one that stood when it was last seen, if green began later.
        """
        if track.speed_mps < STOPPED_MPS:
            since_s = float(self.lane_green_since_s[track.incoming])
            if track.time_s < since_s < math.inf:
                return False
        yellow_s = self._model.site.cabinet.yellow_s
        return bool(track.time_s <= self._last_green_s[track.incoming] + yellow_s)

    def _has_turned_off(self, track: TrackedVehicle) -> bool:
        """Whether a vanished vehicle was at the end of a lane that ends before the stop bars.

        One that vanishes earlier may be a missed detection.
        """
        end_m = self._ends_m.get(track.lane)
        if end_m is None or math.isnan(track.speed_mps):
            return False
        return track.distance_m - track.speed_mps * _TURN_OFF_S <= end_m

    def _note_choice(self, track: TrackedVehicle, lane: int) -> None:
        """Notes which stop bar a vehicle chose; -1 for none."""
        for visited in track.visited:
            counts = self._choices_of(visited)
            counts[lane] += 1
            if counts.sum() > 100:
                counts *= 0.5

    def _note_passage(self, track: TrackedVehicle, time_s: float) -> None:
        lane, track.passed, track.incoming = track.incoming, track.incoming, -1
        self._passed[lane] += self._is_seen[lane]
        self._note_choice(track, lane)
        since_s = float(np.min(self.green_since_s[self._of_lane[lane]]))
        if track.has_stopped and math.isfinite(since_s):
            is_first = self._last_passage_s[lane] < since_s
            values, bounds = (self.lost_s, _LOST_S) if is_first else (self.headway_s, _HEADWAY_S)
            sample_s = time_s - (since_s if is_first else self._last_passage_s[lane])
            if bounds[0] <= sample_s <= bounds[1]:
                values[lane] += _LEARNING * (sample_s - values[lane])
        self._last_passage_s[lane] = time_s
        own = self._of_lane[lane]
        for other in self._tracks.values():
            if track.has_overtaken(other):
                other.wish = np.append(np.zeros(len(own)), 1.0)
                self._note_parked(other)

    def _note_parked(self, track: TrackedVehicle) -> None:
        if track.distance_m >= _HEAD_M:
            self._parked_places.note_sign(track.lane, track.distance_m, track.time_s)
            track.parked_at = track.lane, track.distance_m

    def _find_parked(self, time_s: float) -> None:
        """Finds vehicles that stand in parked places; one that drives off was not parked."""
        places = self._parked_places
        places.forget(time_s)
        for track in self._tracks.values():
            if track.time_s != time_s:
                continue
            is_slow = track.speed_mps < _SLOW_MPS
            if track.parked_at is not None and not is_slow:
                places.disprove(*track.parked_at)
                track.wish = None
            place, is_back = (track.lane, track.distance_m), track.distance_m >= _HEAD_M
            is_parked = is_slow and is_back and places.note_standing(*place, time_s)
            track.parked_at = place if is_parked else None

    def _note_exit(self, track: TrackedVehicle, lane: str) -> None:
        edge = self._model.site.road_map.edge_of(lane)
        for index in self._of_lane[track.passed]:
            if self._model.movements[index].exit_edge == edge:
                own = self._of_lane[track.passed]
                self._turns[index] += 1
                if self._turns[own].sum() > 100:
                    self._turns[own] *= 0.5
                track.passed = -1
                return

    def _watch_heads(self, time_s: float, passed_s: float, shown: Ints) -> None:
        """Lowers the probability that a first vehicle which does not go wants what it may do."""
        shares = self.shares
        for lane, track in enumerate(self._firsts(time_s)):
            self._heads[lane] = None
            self._first_waits[lane] = False
            if track is None:
                continue
            stands, reach_m = track.speed_mps < STOPPED_MPS, self._model.reach_m[lane]
            self._first_waits[lane] = stands and track.distance_m <= reach_m
            if track.wish is None:
                usual = shares[self._of_lane[lane]] * (1 - _STUCK_PRIOR)
                track.wish = np.append(usual, _STUCK_PRIOR)
            if stands:
                self._doubt(track, lane, shown, passed_s)
                if track.wish[-1] > _PARKED and self._is_seen[lane]:
                    self._note_parked(track)
            if track.distance_m < _HEAD_M:
                self._heads[lane] = track.wish

    def _firsts(self, time_s: float) -> list[TrackedVehicle | None]:
        """Returns the first vehicle before each stop bar (L,) that is not parked."""
        firsts: list[TrackedVehicle | None] = [None] * len(self._heads)
        upstream, index_of = self._model.approaches.upstream, self._model.lane_index
        for track in self._tracks.values():
            side = upstream.get(track.lane)
            if side is None or track.time_s != time_s or track.is_parked:
                continue
            lane = index_of[side.counts_for]
            first = firsts[lane]
            if first is None or track.distance_m < first.distance_m:
                firsts[lane] = track
        return firsts

    def _doubt(self, track: TrackedVehicle, lane: int, shown: Ints, passed_s: float) -> None:
        """Updates the wish of a vehicle that stood while it might have gone, if it might.

        Turns that yield wait at the stop bar for a gap: a vehicle that stands farther off with none
        ahead could have come forward.
        """
        assert track.wish is not None
        starts_s = _REACTION_S + max(0.0, track.distance_m) / _START_MPS
        free_s = max(self._last_passage_s[lane], track.stands_since_s)
        is_back = self._is_seen[lane] and track.distance_m >= _HEAD_M
        for place, movement in enumerate(self._of_lane[lane]):
            since_s = max(self.green_since_s[movement], free_s)
            may_go = shown[movement] != RED and self.has_room[movement]
            if may_go and track.time_s - since_s > starts_s:
                patience_s = _PATIENCE_S[PROTECTED if is_back else int(shown[movement])]
                track.wish[place] *= math.exp(-passed_s / patience_s)
        track.wish /= track.wish.sum()

    def _forgive(self, passed_s: float) -> None:
        """Lowers over time the probability that a vehicle is parked: it may have had to wait.

        What it wants else stays as it is; of one of which that is not known it is what is usual.
        """
        upstream, shares = self._model.approaches.upstream, self.shares
        for track in self._tracks.values():
            side = upstream.get(track.lane)
            if side is None or track.wish is None or track.wish[-1] <= _STUCK_PRIOR:
                continue
            own = self._of_lane[self._model.lane_index[side.counts_for]]
            wants = track.wish[:-1] if track.wish[:-1].sum() > 0.0 else shares[own]
            freed = passed_s / _FORGIVEN_S * (track.wish[-1] - _STUCK_PRIOR)
            track.wish = np.append(wants * (1 - track.wish[-1] + freed) / wants.sum(), 0.0)
            track.wish[-1] = 1.0 - track.wish.sum()

    def _note_service(self, time_s: float, shown: Ints, unseen: Collection[str]) -> None:
        """Notes which movements were served: no vehicle waits, or the green was long enough."""
        min_green_s = self._model.site.cabinet.min_green_s
        for index, movement in enumerate(self._model.movements):
            lane = movement.lane
            is_green = shown[index] != RED and time_s - self.green_since_s[index] >= min_green_s
            is_seen = self._model.lanes[lane] not in unseen
            has_right = self._has_protected if is_seen else self._is_planned_protected
            is_right = shown[index] == PROTECTED or not has_right[index]
            has_moved = time_s - self._last_passage_s[lane] < min_green_s
            is_empty = self._heads[lane] is None and not self._first_waits[lane] and is_seen
            if is_empty or (is_green and (is_right or has_moved)):
                self.served_s[index] = time_s


def _lane_ends(model: JunctionModel) -> dict[str, float]:
    """Returns the distance to the stop bar of the end of each lane that is not at one."""
    by_id = model.site.road_map.by_id
    return {
        lane: side.start_m - by_id[lane].measured_m
        for lane, side in model.approaches.upstream.items()
        if lane in by_id and lane not in model.lane_index
    }


def _bars(model: JunctionModel, ends_m: dict[str, float]) -> dict[str, int]:
    """Returns, for each lane that ends near a stop bar, the index of that stop bar's lane.

    A lane counts if it ends so close to a stop bar that vehicles on the short lane between may be
    missed.
    """
    upstream, index_of = model.approaches.upstream, model.lane_index
    close = [lane for lane, end_m in ends_m.items() if end_m < _SHORT_M]
    return {lane: index_of[upstream[lane].counts_for] for lane in close} | index_of
