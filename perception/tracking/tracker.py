"""The tracker: detections of one frame after the other in, tracks out."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.detector import LIDAR, Vehicles
from perception.object_classes import MAX_LENGTH_M
from perception.tracking import motion
from perception.tracking.association import PERSON, associate, is_person
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_graph import LaneGraph
from perception.tracking.sightlines import SightLines
from perception.tracking.tracks import Tracks
from protocol.limits import MAX_POSITION_STD_M

BOX_STD = np.array([0.35, 0.2, 0.08])  # of a detector's box near a sensor: along, across, heading
FAR_STD = 0.015  # along, more for each metre beyond `FAR_M`: only an end of the vehicle is seen
FAR_M = 40.0
RECENT_S, RECENT_HITS = 0.5, 3
GROW, SHRINK = 10, 10
JUMP2 = np.array([0.3, 1.3, 0.0])
SHORT_STD, SHORT_M = 0.015, 10.0
NEAR_STD, NEAR_M = 1.5, 6.0  # along, nearer to a sensor, which sees over a part of the vehicle
NEIGHBOUR_M = 40.0  # who is nearer on a lane tells how fast a new one is likely to be
NEIGHBOUR_STD_MPS = 6.0
FREE_SHARE = 1.0  # of a lane's speed: the likely speed of a new one alone
POSE_STD = np.array([0.1, 0.1, 0.02])  # of an agent's own pose, beside what it says of itself
UNKNOWN_MPS = 8.0  # deviation of the speed of who was seen once, off the map
TURN_RPS = 0.2  # and of its yaw rate
POSE_JUMP_M = 25.0  # an agent that is farther from its track is somewhere else: a new track
FASTEST_MPS = 70.0
LONG_GAP_S = 0.3  # over longer ones who is on a lane follows it, seen or not
HALF_CAR_M = 2.5  # a position is known where its error is less
FIRST_EXISTENCE, MOST_EXISTENCE = 0.6, 0.99
HIT_ODDS = 4.0  # of a detection of a vehicle to one of nothing
SAME_ALONG, SAME_ACROSS_M = 0.6, 1.2  # boxes nearer, of their mean length, are of one vehicle
ADOPTED_STD_MPS = 1.0  # of the speed that another tracker tells
SURE_M = 8.0  # so far on, a lane is no longer mistaken for one that begins beside it
UNSURE_LIFE_S = 0.5  # of a track that is not confirmed


@dataclass(slots=True, eq=False)
class _States:
    """What is known of each track; see `motion` for `mean` and `covariance`.

    `dims` (N, 4) are z, length, width, height, `votes` (N, 4) detections by class. `lane`,
    `along_m` and `off_m` are as of `LaneGraph.locate` in this frame; `origin` is the lane that a
    track was on for sure before, -1 for none. `owner` is the agent whose
    poses a track follows, "lidar" for none; `seen` whether it was detected in this frame, else
    `in_view` how much of its place was seen to be empty.
    """

    ids: Ints
    mean: Floats
    covariance: Floats
    dims: Floats
    votes: Floats
    score: Floats
    existence: Floats
    hits: Ints
    first_ns: Ints
    last_ns: Ints
    lane: Ints
    along_m: Floats
    off_m: Floats
    origin: Ints
    in_view: Floats
    seen: Bools
    owner: np.ndarray

    @classmethod
    def none(cls) -> _States:
        whole, real = np.zeros(0, np.int64), np.zeros(0)
        return cls(
            ids=whole,
            mean=np.zeros((0, 6)),
            covariance=np.zeros((0, 6, 6)),
            dims=np.zeros((0, 4)),
            votes=np.zeros((0, 4)),
            score=real,
            existence=real,
            hits=whole,
            first_ns=whole,
            last_ns=whole,
            lane=whole,
            along_m=real,
            off_m=real,
            origin=whole,
            in_view=real,
            seen=np.zeros(0, np.bool_),
            owner=np.zeros(0, object),
        )

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: Ints | Bools) -> _States:
        return _States(*(getattr(self, one.name)[chosen] for one in fields(self)))

    def __add__(self, other: _States) -> _States:
        names = [one.name for one in fields(self)]
        return _States(*(np.concatenate([getattr(s, n) for s in (self, other)]) for n in names))

    @property
    def boxes(self) -> Floats:
        """Returns them as boxes (N, 7)."""
        return np.column_stack([self.mean[:, :2], self.dims, self.mean[:, 2]])


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
        self._states = _States.none()
        self._time_ns: int | None = None
        self._last = Tracks.none()
        self.refused = 0

    @property
    def time_ns(self) -> int | None:
        """The time of the last frame."""
        return self._time_ns

    def step(self, time_ns: int, observed: Vehicles, visible: SightLines | None = None) -> Tracks:
        """Takes a frame's detections; returns the tracks that are to be published.

        The time of the last frame again changes nothing. Of more than `max_tracks` detections those
        of the lowest scores are left out and counted in `refused`.

        Args:
            time_ns: when the detections were; frames may be missing.
            observed: detections, without duplicates, those with a source other than "lidar" being
                agents' own poses.
            visible: what sensors looked through in this frame; None if nobody knows.

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
        std, seen = _std(observed, visible)
        self._predict(dt_s)
        pairs = self._match(observed, std)
        self._correct(time_ns, observed, std, seen, pairs)
        self._doubt(dt_s, visible)
        new = self._is_new(observed, pairs)
        self._states = self._states + self._born(time_ns, observed.take(new), std[new])
        self._locate()
        self._last = self._published(time_ns)
        return self._last

    def forget(self) -> None:
        """Forgets all tracks and the time, not which ids were given."""
        self._states, self._time_ns, self._last = _States.none(), None, Tracks.none()

    def adopt(self, time_ns: int, others: Tracks) -> None:
        """Takes over the ids of another tracker for the same vehicles, and vehicles that it knows.

        To be called between two frames. Where the time is not that of the last frame, nothing is
        taken over.
        """
        if self._time_ns is None or time_ns != self._time_ns or not len(others):
            return
        states = self._states
        unknown = others.take(~np.isin(others.track_ids, states.ids))
        apart = np.linalg.norm(unknown.boxes[:, None, :2] - states.mean[None, :, :2], axis=2)
        apart[:, np.isin(states.ids, others.track_ids)] = np.inf
        mine = _nearest(apart, HALF_CAR_M)
        states.ids[mine[mine >= 0]] = unknown.track_ids[mine >= 0]
        left = unknown.take(mine < 0)
        left = left.take(~_overlapping(left.boxes, states.boxes))
        left = left.take(slice(max(self._config.max_tracks - len(states), 0)))
        self._states = states + self._adopted(time_ns, left)

    def _adopted(self, time_ns: int, others: Tracks) -> _States:
        first_id = self._next_id
        found = Vehicles.from_lidar(others.boxes, others.existence, others.classes)
        born = self._born(time_ns, found, np.tile(BOX_STD, (len(others), 1)))
        self._next_id = first_id
        born.ids, born.existence = others.track_ids, others.existence.copy()
        born.mean[:, 3] = others.speeds_mps
        born.covariance[:, 3, 3] = ADOPTED_STD_MPS**2
        born.hits[:] = self._config.confirm_hits
        born.first_ns = others.first_seen_ns.copy()
        born.last_ns = time_ns - np.round(others.coasted_s * 1e9).astype(np.int64)
        born.seen = others.coasted_s == 0
        return born

    def _bounded(self, observed: Vehicles) -> Vehicles:
        """Returns the detections in an order of their own, and no more than are allowed."""
        number = {source: rank for rank, source in enumerate(sorted(set(observed.sources)))}
        sources = [number[source] for source in observed.sources]
        order = np.lexsort([*observed.boxes.T[::-1], sources, -observed.scores])
        self.refused += max(len(order) - self._config.max_tracks, 0)
        return observed.take(order[: self._config.max_tracks])

    def _predict(self, dt_s: float) -> None:
        """Moves all tracks on: on lanes who is hidden, or long unseen; in the open all others."""
        states, config = self._states, self._config
        if not len(states) or dt_s == 0.0:
            return
        coasts = ~states.seen
        free = (states.lane < 0) | ~(coasts | (dt_s > LONG_GAP_S))
        steady = coasts & ~free
        accel = np.where(steady, config.coast_accel_std_mps2, config.accel_std_mps2)
        motion.predict(
            states.mean, states.covariance, dt_s, accel, config.turn_std_rps, free, steady, motion.TUNE
        )
        if self._lanes is not None and not free.all():
            self._follow_lanes(dt_s, free)

    def _follow_lanes(self, dt_s: float, free: Bools) -> None:
        lanes, states = self._lanes, self._states
        assert lanes is not None
        solid = states.hits >= self._config.confirm_hits
        motion.follow_lanes(
            states.mean, states.covariance, states.dims, states.lane, states.along_m, states.off_m,
            states.existence, dt_s, free, solid, lanes.segments, lanes.first, lanes.length_m,
            lanes.speed_mps, lanes.leads, lanes.followers, self._trips,
        )  # fmt: skip

    def _match(self, observed: Vehicles, std: Floats) -> Ints:
        """Returns for each detection its track, an index or -1: an agent's own one first."""
        states = self._states
        pairs = np.full(len(observed), -1, np.int64)
        if not len(states):
            return pairs
        own = {owner: n for n, owner in enumerate(states.owner.tolist()) if owner != LIDAR}
        for m, source in enumerate(observed.sources):
            n = own.get(source, -1)
            if n < 0:
                continue
            x, y = observed.boxes[m, :2] - states.mean[n, :2]
            if np.hypot(x, y) <= POSE_JUMP_M + 2 * observed.position_std_m[m]:
                pairs[m] = n
            else:
                states.owner[n] = LIDAR
        self._pair(observed, std, pairs)
        kept = states.covariance.copy()
        again = _unpaired(pairs, len(states))
        self._loosen(pairs)
        self._pair(observed, std, pairs)
        states.covariance[again] = kept[again]
        again &= ~_unpaired(pairs, len(states))
        motion.loosen(states.mean, states.covariance, np.flatnonzero(again), JUMP2)
        self._reclaim(observed, pairs)
        return pairs

    def _reclaim(self, observed: Vehicles, pairs: Ints) -> None:
        """Gives detections at the place of a track without one to it, if it is the older one.

        Where a vehicle is seen in parts, a second track begins on it now and then.
        """
        states = self._states
        taken = np.flatnonzero(pairs >= 0)
        left = np.flatnonzero(_unpaired(pairs, len(states)))
        if not len(taken) or not len(left):
            return
        coasted_s = (self._now() - states.last_ns[left]) / 1e9
        order = np.argsort(-states.hits[left], kind="stable")
        boxes = states.boxes
        for i in order:
            n = left[i]
            near = taken[np.abs(observed.boxes[taken, 0] - boxes[n, 0]) < MAX_LENGTH_M]
            near = near[_overlapping(observed.boxes[near], boxes[n : n + 1])]
            for m in near:
                other = pairs[m]
                is_young = states.hits[other] < states.hits[n]
                if is_young and (coasted_s[i] <= RECENT_S or states.hits[other] <= RECENT_HITS):
                    pairs[m] = n
                    break

    def _pair(self, observed: Vehicles, std: Floats, pairs: Ints) -> None:
        """Fills in the tracks of detections that have none yet."""
        states = self._states
        boxes = np.flatnonzero(pairs < 0)
        tracks = np.flatnonzero(_unpaired(pairs, len(states)))
        if not len(boxes) or not len(tracks):
            return
        seen, person = observed.take(boxes), is_person(states.votes[tracks].argmax(axis=1))
        found = associate(
            states.mean[tracks],
            states.covariance[tracks],
            np.column_stack([states.dims[tracks, 1], person]),
            states.existence[tracks],
            np.column_stack([seen.boxes, is_person(seen.classes)]),
            std[boxes],
            self._config.gate,
        )
        is_paired = found >= 0
        pairs[boxes[is_paired]] = tracks[found[is_paired]]

    def _loosen(self, pairs: Ints) -> None:
        """Allows for more than noise in tracks without a detection: a change of lane, a jump.

        A box jumps when another side of the vehicle comes into view.
        """
        states = self._states
        missed = _unpaired(pairs, len(states))
        jumps = motion.JUMP_STD if self._lanes is not None else motion.JUMP_STD_OFF_MAP
        motion.loosen(states.mean, states.covariance, np.flatnonzero(missed), jumps)

    def _correct(
        self, time_ns: int, observed: Vehicles, std: Floats, seen_from: Floats, pairs: Ints
    ) -> None:
        states = self._states
        states.seen[:] = False
        states.in_view[:] = 0.0
        matched = np.flatnonzero(pairs >= 0)
        tracks = pairs[matched]
        if not len(tracks):
            return
        seen = observed.take(matched)
        motion.correct(
            states.mean, states.covariance, np.ascontiguousarray(states.dims[:, 1]), tracks,
            np.ascontiguousarray(seen.boxes), std[matched], seen_from[matched], motion.TUNE,
        )
        np.clip(states.mean[:, 3], -FASTEST_MPS, FASTEST_MPS, out=states.mean[:, 3])
        states.seen[tracks] = True
        states.hits[tracks] += 1
        states.last_ns[tracks] = time_ns
        states.score[tracks] = seen.scores
        odds = states.existence[tracks] * HIT_ODDS
        sure = odds / (odds + 1 - states.existence[tracks])
        states.existence[tracks] = np.minimum(sure, MOST_EXISTENCE)
        dims = seen.boxes[:, 2:6]
        more = dims[:, 1:] - states.dims[tracks, 1:]
        new = 1 / np.minimum(states.hits[tracks][:, None], np.where(more > 0, GROW, SHRINK))
        states.dims[tracks, 1:] += new * more
        states.dims[tracks, 0] = dims[:, 0]
        states.votes[tracks, seen.classes] += seen.scores
        for n, source in zip(tracks.tolist(), seen.sources, strict=True):
            if source != LIDAR:
                states.owner[n] = source

    def _doubt(self, dt_s: float, visible: SightLines | None) -> None:
        """Lowers the existence of who was not detected, by what should have been seen there."""
        states, config = self._states, self._config
        missed = np.flatnonzero(~states.seen)
        if not len(missed):
            return
        existence = states.existence[missed]
        if visible is None:
            existence = existence * np.exp(-dt_s / config.blind_life_s)
        else:
            empty = visible.empty(states.boxes[missed])
            states.in_view[missed] = empty
            lives_per_s = (1 - empty) / config.shadow_life_s + empty / config.empty_life_s
            existence = existence * np.exp(-dt_s * lives_per_s)
        unsure = states.hits[missed] < config.confirm_hits
        existence = existence * np.where(unsure, np.exp(-dt_s / UNSURE_LIFE_S), 1.0)
        coasted_s = (self._now() - states.last_ns[missed]) / 1e9
        existence[coasted_s > config.max_coast_s] = 0.0
        existence[self._overlaps(missed)] = 0.0
        states.existence[missed] = existence
        self._states = states.take(states.existence >= config.min_existence)

    def _overlaps(self, missed: Ints) -> Bools:
        """Whether each of some tracks lies where another one was detected."""
        states = self._states
        boxes, seen = states.boxes[missed], states.boxes[states.seen]
        return np.asarray(_overlapping(boxes, seen))

    def _is_new(self, observed: Vehicles, pairs: Ints) -> Bools:
        """Whether each detection is a vehicle of its own, not another box of one that is known."""
        new = pairs < 0
        known = self._states.boxes[self._states.seen]
        new[new] = ~_overlapping(observed.boxes[new], known)
        new[new] = _first_of_each(observed.boxes[new])
        room = self._config.max_tracks - len(self._states)
        self.refused += max(int(new.sum()) - room, 0)
        new[np.flatnonzero(new)[max(room, 0) :]] = False
        return np.asarray(new)

    def _born(self, time_ns: int, new: Vehicles, std: Floats) -> _States:
        """Returns new tracks."""
        count = len(new)
        if not count:
            return _States.none()
        mean = np.column_stack([new.boxes[:, :2], new.boxes[:, 6], np.zeros((count, 3))])
        covariance = np.zeros((count, 6, 6))
        cos, sin = np.cos(mean[:, 2]), np.sin(mean[:, 2])
        along, across = std[:, 0] ** 2, std[:, 1] ** 2
        covariance[:, 0, 0] = along * cos**2 + across * sin**2
        covariance[:, 1, 1] = along * sin**2 + across * cos**2
        covariance[:, 0, 1] = covariance[:, 1, 0] = (along - across) * cos * sin
        covariance[:, 2, 2] = std[:, 2] ** 2
        covariance[:, 3, 3] = UNKNOWN_MPS**2
        covariance[:, 4, 4] = TURN_RPS**2
        covariance[:, 5, 5] = motion.TUNE[1]**2
        votes = np.zeros((count, 4))
        votes[np.arange(count), new.classes] = new.scores + 1e-3
        number, stamp = np.full(count, -1), np.full(count, time_ns)
        born = _States(
            ids=self._next_id + np.arange(count),
            mean=mean,
            covariance=covariance,
            dims=new.boxes[:, 2:6].copy(),
            votes=votes,
            score=new.scores.copy(),
            existence=np.full(count, FIRST_EXISTENCE),
            hits=np.ones(count, np.int64),
            first_ns=stamp,
            last_ns=stamp.copy(),
            lane=number,
            along_m=np.zeros(count),
            off_m=np.zeros(count),
            origin=number.copy(),
            in_view=np.zeros(count),
            seen=np.ones(count, np.bool_),
            owner=np.array(new.sources, object),
        )
        if self._lanes is not None:
            born.lane, born.along_m, born.off_m = self._lanes.locate(born.boxes)
            self._guess_speeds(born)
        self._next_id += count
        return born

    def _guess_speeds(self, born: _States) -> None:
        """Gives new tracks on lanes the speed of the nearest known one there, or that of the lane.

        People are on no lane.
        """
        states, lanes = self._states, self._lanes
        assert lanes is not None
        born.lane[born.votes.argmax(axis=1) == PERSON] = -1
        sure = np.flatnonzero(states.hits >= self._config.confirm_hits)
        for n in np.flatnonzero(born.lane >= 0):
            near = sure[states.lane[sure] == born.lane[n]]
            gap_m = np.abs(states.along_m[near] - born.along_m[n])
            is_alone = not len(near) or gap_m.min() > NEIGHBOUR_M
            limit_mps = lanes.speed_mps[born.lane[n]]
            likely = FREE_SHARE * limit_mps if is_alone else states.mean[near[gap_m.argmin()], 3]
            born.mean[n, 3] = likely
            born.covariance[n, 3, 3] = NEIGHBOUR_STD_MPS**2

    def _locate(self) -> None:
        """Finds the lanes of the tracks that were detected, and learns which ways vehicles take."""
        states, lanes = self._states, self._lanes
        seen = np.flatnonzero(states.seen)
        if lanes is None or not len(seen):
            return
        lane, along_m, off_m = lanes.locate(states.boxes[seen])
        is_person = states.votes[seen].argmax(axis=1) == PERSON
        lane[is_person] = -1
        states.lane[seen], states.along_m[seen], states.off_m[seen] = lane, along_m, off_m
        sure = (lane >= 0) & (along_m > np.minimum(SURE_M, lanes.length_m[lane] / 2))
        for n, new in zip(seen[sure].tolist(), lane[sure].tolist(), strict=True):
            old = states.origin[n]
            if old not in (-1, new):
                ways = slice(lanes.leads[old], lanes.leads[old + 1])
                self._trips[ways] += lanes.followers[ways] == new
            states.origin[n] = new

    def _now(self) -> int:
        assert self._time_ns is not None
        return self._time_ns

    def _published(self, time_ns: int) -> Tracks:
        states, config = self._states, self._config
        cos, sin = np.cos(states.mean[:, 2]), np.sin(states.mean[:, 2])
        p = states.covariance
        variance = p[:, 0, 0] * cos**2 + 2 * p[:, 0, 1] * cos * sin + p[:, 1, 1] * sin**2
        along_m = np.sqrt(np.maximum(variance, 0))
        confirmed = states.hits >= config.confirm_hits
        known = states.existence * (1 - states.in_view) * _within(along_m)
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


def _std(observed: Vehicles, visible: SightLines | None) -> tuple[Floats, Floats]:
    """Returns by how much detections are off along, across and in heading (N, 3)."""
    is_pose = np.array([source != LIDAR for source in observed.sources], np.bool_)
    std = np.where(is_pose[:, None], POSE_STD, BOX_STD)
    seen = np.zeros((len(observed), 3))
    seen[:, 2] = is_pose
    if visible is not None and len(visible.sensors):
        apart = visible.sensors[:, :2] - observed.boxes[:, None, :2]
        ranges = np.linalg.norm(apart, axis=2)
        nearest = ranges.argmin(axis=1)
        rows = np.arange(len(observed))
        range_m = ranges[rows, nearest]
        std[~is_pose, 0] += FAR_STD * np.maximum(range_m[~is_pose] - FAR_M, 0.0)
        std[~is_pose & (range_m < NEAR_M), 0] = NEAR_STD
        yaw = observed.boxes[:, 6]
        to = apart[rows, nearest]
        seen[:, 0] = np.where(is_pose, 0.0, np.cos(yaw) * to[:, 0] + np.sin(yaw) * to[:, 1])
        seen[:, 1] = range_m
    std[:, :2] = np.hypot(std[:, :2], observed.position_std_m[:, None])
    return np.ascontiguousarray(std), seen


def _unpaired(pairs: Ints, tracks: int) -> Bools:
    """Marks the tracks that no detection belongs to."""
    result = np.ones(tracks, np.bool_)
    result[pairs[pairs >= 0]] = False
    return result


def _nearest(apart: Floats, most: float) -> Ints:
    """Returns for each row (N, M) the column that is its own by pairs, nearest first, or -1."""
    result = np.full(len(apart), -1, np.int64)
    free = np.ones(apart.shape[1], np.bool_)
    rows, columns = np.nonzero(apart < most)
    for pair in np.argsort(apart[rows, columns], kind="stable"):
        row, column = rows[pair], columns[pair]
        if result[row] < 0 and free[column]:
            result[row], free[column] = column, False
    return result


def _within(std_m: Floats) -> Floats:
    """Returns the probability (N,) of an error of less than half a car, normally distributed.

    By the logistic approximation of the normal distribution (Bowling et al. 2009).
    """
    t = HALF_CAR_M / np.maximum(std_m, 1e-3)
    return np.asarray(2 / (1 + np.exp(-np.minimum(1.5976 * t + 0.07056 * t**3, 700.0))) - 1)


@njit("boolean(float64[:], float64[:])", cache=True)
def _is_same(box: Floats, other: Floats) -> bool:
    """Whether two boxes lie so much in one place that they are of one vehicle."""
    x, y = box[0] - other[0], box[1] - other[1]
    cos, sin = np.cos(other[6]), np.sin(other[6])
    reach_m = SAME_ALONG * (box[3] + other[3]) / 2
    return bool(abs(cos * x + sin * y) < reach_m and abs(cos * y - sin * x) < SAME_ACROSS_M)


@njit("boolean[::1](float64[:,:], float64[:,:])", cache=True)
def _overlapping(boxes: Floats, others: Floats) -> Bools:
    """Whether each box (N, 7) lies where any of the others (M, 7) is."""
    result = np.zeros(boxes.shape[0], np.bool_)
    for n in range(boxes.shape[0]):
        for m in range(others.shape[0]):
            if abs(boxes[n, 0] - others[m, 0]) < MAX_LENGTH_M and _is_same(boxes[n], others[m]):
                result[n] = True
                break
    return result


@njit("boolean[::1](float64[:,:])", cache=True)
def _first_of_each(boxes: Floats) -> Bools:
    """Marks the boxes (N, 7) that lie where none before them does that is marked."""
    result = np.zeros(boxes.shape[0], np.bool_)
    for n in range(boxes.shape[0]):
        result[n] = True
        for m in range(n):
            if result[m] and _is_same(boxes[n], boxes[m]):
                result[n] = False
                break
    return result
