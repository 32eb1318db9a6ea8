"""The multi-object tracker: detections in, tracks out, frame by frame."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from perception.arrays import Bools, Floats, Ints
from perception.detector import LIDAR, Vehicles
from perception.tracking import motion
from perception.tracking.association import PERSON
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_following import CRUISE_STD_MPS, cruise, follow_lanes
from perception.tracking.lane_graph import LaneGraph
from perception.tracking.life_cycle import (
    SURE_HITS,
    begin_again,
    born,
    lower_existence,
    place_on_lanes,
    position_known,
    raised_existence,
)
from perception.tracking.pairing import pair
from perception.tracking.places import first_of_each, nearest, overlapping
from perception.tracking.sightlines import SightLines
from perception.tracking.states import TrackStates
from perception.tracking.tracks import Tracks
from protocol.limits import MAX_POSITION_STD_M

FASTEST_MPS = 70.0
LONG_GAP_S = 0.3  # over longer ones a track on a lane follows it, seen or not
ADOPTED_STD_MPS = 1.0  # of the speed that another tracker states
ADOPTED_M = 2.5  # tracks of two trackers that are nearer are of one vehicle
SURE_M = 8.0  # so far on, a lane is no longer mistaken for one that begins beside it
SIZES = 10  # detections over which a size is the mean


class Tracker:
    """Follows vehicles; the same frames give the same tracks, whatever the order of detections.

    Along lanes where there are any, in the open elsewhere. Ids rise from `first_id`.
    """

    def __init__(
        self, config: TrackingConfig, lanes: LaneGraph | None = None, *, first_id: int = 1
    ) -> None:
        self._config = config
        self._lanes = lanes
        self._trips = lanes.prior.copy() if lanes is not None else np.zeros(0)
        self._next_id = first_id
        self._states = TrackStates.none()
        self._time_ns: int | None = None
        self._last = Tracks.none()
        self.refused = 0

    @property
    def time_ns(self) -> int | None:
        """The time of the last frame."""
        return self._time_ns

    def step(
        self,
        time_ns: int,
        observed: Vehicles,
        visible: SightLines | None = None,
        signals: Mapping[str, str] | None = None,
    ) -> Tracks:
        """Takes a frame's detections; returns the tracks that are to be published.

        The time of the last frame again changes nothing. Of more than `max_tracks` detections those
        of the lowest scores are left out and counted in `refused`.

        Args:
            time_ns: when the detections were; frames may be missing.
            observed: detections, without duplicates, those with a source other than "lidar" being
                agents' own poses.
            visible: sight lines of the sensors in this frame; None if unknown.
            signals: what signals have shown since the last frame, as `LaneGraph.lights` takes it.

        Raises:
            ValueError: the time lies before that of the last frame.
        """
        if self._time_ns is not None and time_ns <= self._time_ns:
            if time_ns == self._time_ns:
                return self._last
            raise ValueError(f"frame at {time_ns} ns follows one at {self._time_ns} ns")
        dt_s = 0.0 if self._time_ns is None else (time_ns - self._time_ns) / 1e9
        self._time_ns = time_ns
        observed = self._bounded(observed)
        std, seen = motion.deviations(observed, visible)
        self._predict(dt_s, signals or {})
        jump_std = motion.jumps(dt_s, on_map=self._lanes is not None)
        gate, hits = self._config.gate, self._config.confirm_hits
        pairs, vague = pair(
            self._states,
            observed,
            std,
            time_ns,
            gate=gate,
            jump_std=jump_std,
            confirm_hits=hits,
            along_lane=self._along_lane(observed.boxes),
        )
        self._correct(time_ns, observed, std, seen, pairs, vague)
        lower_existence(self._states, time_ns, dt_s, visible, self._config)
        exist = self._states.existence >= self._config.min_existence
        if not exist.all():
            self._states = self._states.take(exist)
        new = self._is_new(observed, pairs)
        self._locate(dt_s)
        if new.any():
            born = self._born(time_ns, observed.take(new), std[new], signals or {})
            begin_again(time_ns, born, self._states)
            self._states = self._states + born
        self._last = self._published(time_ns)
        return self._last

    def forget(self) -> None:
        """Forgets all tracks and the time, not which ids were used."""
        self._states, self._time_ns, self._last = TrackStates.none(), None, Tracks.none()

    def distrust(self, agents: Collection[str], places: Floats, reach_m: float) -> None:
        """Makes tracks that agents may have invented need confirmation: their own, those near them.

        To be called between two frames. One that is detected again keeps its id; others do not
        coast.

        Args:
            agents: whose data are no longer used.
            places: where their sensors were (K, 2 or 3), map frame.
            reach_m: how far they see.
        """
        states = self._states
        apart_m = np.linalg.norm(states.mean[:, None, :2] - places[None, :, :2], axis=2)
        doubted = (apart_m <= reach_m).any(axis=1)
        doubted |= np.array([owner in agents for owner in states.owner], np.bool_)
        states.hits[doubted] = states.wholes[doubted] = 0

    def adopt(self, time_ns: int, others: Tracks) -> None:
        """Adopts another tracker's tracks: ids of the same vehicles, and vehicles unknown here.

        To be called between two frames. Where the time is not that of the last frame, nothing is
        taken over.
        """
        if self._time_ns is None or time_ns != self._time_ns or not len(others):
            return
        states = self._states
        unknown = others.take(~np.isin(others.track_ids, states.ids))
        apart = np.linalg.norm(unknown.boxes[:, None, :2] - states.mean[None, :, :2], axis=2)
        apart[:, np.isin(states.ids, others.track_ids)] = np.inf
        mine = nearest(apart, ADOPTED_M)
        states.ids[mine[mine >= 0]] = unknown.track_ids[mine >= 0]
        left = unknown.take(mine < 0)
        left = left.take(~overlapping(left.boxes, states.boxes))
        left = left.take(slice(max(self._config.max_tracks - len(states), 0)))
        self._states = states + self._adopted(time_ns, left)

    def _adopted(self, time_ns: int, others: Tracks) -> TrackStates:
        first_id = self._next_id
        found = Vehicles.from_lidar(others.boxes, others.existence, others.classes)
        adopted = self._born(time_ns, found, np.tile(motion.BOX_STD, (len(others), 1)), {})
        self._next_id = first_id
        adopted.ids, adopted.existence = others.track_ids, others.existence.copy()
        adopted.mean[:, 3] = others.speeds_mps
        adopted.covariance[:, 3, 3] = ADOPTED_STD_MPS**2
        if self._lanes is not None:
            limit_mps = self._lanes.speed_mps[adopted.lane]
            steady = np.zeros(len(adopted))
            found_cruise = cruise(adopted.cruise, others.speeds_mps, steady, limit_mps, 0.0)
            adopted.cruise = np.where(adopted.lane >= 0, found_cruise, np.nan)
        adopted.hits[:] = max(self._config.confirm_hits, SIZES)
        adopted.first_ns = others.first_seen_ns.copy()
        adopted.last_ns = time_ns - np.round(others.coasted_s * 1e9).astype(np.int64)
        adopted.seen = others.coasted_s == 0
        return adopted

    def _bounded(self, observed: Vehicles) -> Vehicles:
        """Returns the detections in an order of their own, and no more than are allowed."""
        number = {source: rank for rank, source in enumerate(sorted(set(observed.sources)))}
        sources = [number[source] for source in observed.sources]
        order = np.lexsort([*observed.boxes.T[::-1], sources, -observed.scores])
        self.refused += max(len(order) - self._config.max_tracks, 0)
        return observed.take(order[: self._config.max_tracks])

    def _predict(self, dt_s: float, signals: Mapping[str, str]) -> None:
        """Predicts all tracks: hidden or long unseen ones on lanes, others by the motion model."""
        states, config = self._states, self._config
        if not len(states) or dt_s == 0.0:
            return
        coasts = ~states.seen
        free = (states.lane < 0) | ~(coasts | (dt_s > LONG_GAP_S))
        steady = coasts & ~free
        accel = np.where(steady, config.coast_accel_std_mps2, config.accel_std_mps2)
        motion.predict(
            states.mean, states.covariance, dt_s, accel, config.turn_std_rps, free, steady
        )
        if self._lanes is not None:
            self._follow_lanes(dt_s, free, signals)

    def _follow_lanes(self, dt_s: float, free: Bools, signals: Mapping[str, str]) -> None:
        lanes, states = self._lanes, self._states
        assert lanes is not None
        solid, known = states.hits >= self._config.confirm_hits, states.hits >= SURE_HITS
        follow_lanes(
            states.mean, states.covariance, states.dims, states.lane, states.along_m, states.off_m,
            states.existence, states.cruise, dt_s, free, states.seen, solid, known,
            lanes.segments, lanes.first, lanes.length_m, lanes.speed_mps, lanes.leads,
            lanes.followers, self._trips, lanes.lights(signals),
        )  # fmt: skip

    def _correct(
        self,
        time_ns: int,
        observed: Vehicles,
        std: Floats,
        seen_from: Floats,
        pairs: Ints,
        vague: Bools,
    ) -> None:
        states = self._states
        states.seen[:] = False
        states.in_view[:] = 0.0
        matched = np.flatnonzero(pairs >= 0)
        tracks = pairs[matched]
        if not len(tracks):
            return
        seen = observed.take(matched)
        boxes = np.ascontiguousarray(seen.boxes)
        states.hits[tracks] += 1
        vague = vague[matched] | motion.abreast(
            states.mean, states.covariance, tracks, boxes, seen_from[matched]
        )
        self._measure(tracks[~vague], seen.take(~vague), seen_from[matched][~vague])
        motion.correct(
            states.mean,
            states.covariance,
            np.ascontiguousarray(states.dims[:, 1]),
            states.lane >= 0,
            tracks,
            boxes,
            std[matched],
            seen_from[matched],
            np.ascontiguousarray(seen.ends_m),
            vague,
        )
        np.clip(states.mean[:, 3], -FASTEST_MPS, FASTEST_MPS, out=states.mean[:, 3])
        states.seen[tracks] = True
        states.last_ns[tracks] = time_ns
        states.score[tracks] = seen.scores
        states.existence[tracks] = raised_existence(states.existence[tracks])
        states.votes[tracks[~vague], seen.classes[~vague]] += seen.scores[~vague]
        for n, source in zip(tracks.tolist(), seen.sources, strict=True):
            if source != LIDAR:
                states.owner[n] = source

    def _measure(self, tracks: Ints, seen: Vehicles, seen_from: Floats) -> None:
        """Takes the means of sizes; of lengths, once both ends were seen, of those alone.

        The end turned to the sensor, by which a vehicle's place is known, stays where it is.
        """
        states = self._states
        length_m = seen.whole_lengths_m()
        whole = ~np.isnan(length_m)
        states.wholes[tracks] += whole
        wholes, hits = states.wholes[tracks], states.hits[tracks]
        new = np.column_stack([np.where(wholes > 0, wholes, hits), hits, hits])
        new = 1 / np.minimum(new, SIZES)
        new[~whole & (wholes > 0), 0] = 0.0
        sizes_m = np.column_stack([np.where(whole, length_m, seen.boxes[:, 3]), seen.boxes[:, 4:6]])
        known = motion.known_ends(seen.boxes[:, 3], seen_from, seen.ends_m)
        more_m = new[:, 0] * (sizes_m[:, 0] - states.dims[tracks, 1])
        yaw = states.mean[tracks, 2]
        ahead = np.cos(seen.boxes[:, 6] - yaw) >= 0.0  # a box's heading may be reversed
        back_m = np.where(ahead, known, -known) * more_m / 2
        states.mean[tracks, 0] -= back_m * np.cos(yaw)
        states.mean[tracks, 1] -= back_m * np.sin(yaw)
        states.dims[tracks, 1:] += new * (sizes_m - states.dims[tracks, 1:])
        states.dims[tracks, 0] = seen.boxes[:, 2]

    def _is_new(self, observed: Vehicles, pairs: Ints) -> Bools:
        """Whether each detection is a vehicle of its own, not another box of one that is known."""
        new = pairs < 0
        known = self._states.boxes[self._states.seen]
        new[new] = ~overlapping(observed.boxes[new], known)
        new[new] = first_of_each(observed.boxes[new])
        room = self._config.max_tracks - len(self._states)
        self.refused += max(int(new.sum()) - room, 0)
        new[np.flatnonzero(new)[max(room, 0) :]] = False
        return np.asarray(new)

    def _born(
        self, time_ns: int, new: Vehicles, std: Floats, signals: Mapping[str, str]
    ) -> TrackStates:
        """Returns new tracks, with ids of their own, on their lanes."""
        if not len(new):
            return TrackStates.none()
        result = born(time_ns, new, std, self._next_id)
        self._next_id += len(new)
        if self._lanes is not None:
            sure = self._states.hits >= self._config.confirm_hits
            held = self._lanes.held(signals)
            place_on_lanes(result, self._states, sure, self._lanes, self._trips, held)
        return result

    def _along_lane(self, boxes: Floats) -> Bools:
        """Marks the boxes (N, 7) that lie along a lane, in its direction."""
        if self._lanes is None:
            return np.zeros(len(boxes), np.bool_)
        return np.asarray(self._lanes.locate(boxes)[0] >= 0)

    def _locate(self, dt_s: float) -> None:
        """Finds the lanes of detected tracks; learns how fast they drive and where they turn."""
        states, lanes = self._states, self._lanes
        seen = np.flatnonzero(states.seen)
        if lanes is None or not len(seen):
            return
        lane, along_m, off_m = lanes.locate(states.boxes[seen])
        is_person = states.votes[seen].argmax(axis=1) == PERSON
        lane[is_person] = -1
        states.lane[seen], states.along_m[seen], states.off_m[seen] = lane, along_m, off_m
        self._learn_speeds(
            seen[(lane >= 0) & (states.covariance[seen, 3, 3] < CRUISE_STD_MPS**2)], dt_s
        )
        sure = (lane >= 0) & (along_m > np.minimum(SURE_M, lanes.length_m[lane] / 2))
        places = seen[sure]
        before, now = states.origin[places], lane[sure]
        states.origin[places] = now
        for old, new in zip(
            before[before != now].tolist(), now[before != now].tolist(), strict=True
        ):
            if old >= 0:
                ways = slice(lanes.leads[old], lanes.leads[old + 1])
                self._trips[ways] += lanes.followers[ways] == new

    def _learn_speeds(self, known: Ints, dt_s: float) -> None:
        """Notes how fast some tracks on lanes drive, of which the speeds are known."""
        states, lanes = self._states, self._lanes
        assert lanes is not None
        states.cruise[known] = cruise(
            states.cruise[known],
            states.mean[known, 3],
            states.mean[known, 5],
            lanes.speed_mps[states.lane[known]],
            dt_s,
        )

    def _published(self, time_ns: int) -> Tracks:
        states, config = self._states, self._config
        cos, sin = np.cos(states.mean[:, 2]), np.sin(states.mean[:, 2])
        p = states.covariance
        variance = p[:, 0, 0] * cos**2 + 2 * p[:, 0, 1] * cos * sin + p[:, 1, 1] * sin**2
        along_m = np.sqrt(np.maximum(variance, 0))
        confirmed = states.hits >= config.confirm_hits
        known = position_known(states, along_m)
        coasts = confirmed & (known >= config.publish_probability)
        shown = np.where(states.seen, confirmed | (states.score >= config.birth_score), coasts)
        chosen = np.flatnonzero(shown)
        chosen = chosen[np.argsort(states.ids[chosen], kind="stable")]
        own = [o if s else LIDAR for o, s in zip(states.owner, states.seen, strict=True)]
        return Tracks(
            track_ids=states.ids[chosen],
            boxes=states.boxes[chosen],
            speeds_mps=states.mean[chosen, 3],
            yaw_rates_rps=states.mean[chosen, 4],
            position_std_m=np.minimum(along_m[chosen], MAX_POSITION_STD_M),
            speed_std_mps=np.minimum(np.sqrt(p[chosen, 3, 3]), FASTEST_MPS),
            scores=np.where(states.seen, states.score, known)[chosen],
            existence=states.existence[chosen],
            first_seen_ns=states.first_ns[chosen],
            coasted_s=(time_ns - states.last_ns[chosen]) / 1e9,
            classes=states.votes[chosen].argmax(axis=1).astype(np.uint8),
            sources=[own[n] for n in chosen],
        )
