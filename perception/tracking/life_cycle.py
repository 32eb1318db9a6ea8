"""The life cycle of tracks: birth by a detection, and the probability that they still exist.

A track's existence is the probability that its vehicle is there. With each detection it rises.
Without one it falls: fast where its place is in plain view of a sensor, slowly in a shadow.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from perception.arrays import Bools, Floats
from perception.detector import Vehicles
from perception.tracking import motion
from perception.tracking.association import PERSON
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_following import BAR_M
from perception.tracking.lane_graph import LaneGraph, likeliest
from perception.tracking.places import apart_of_same, nearest, overlapping
from perception.tracking.sightlines import SightLines
from perception.tracking.states import CLASSES, TrackStates

NEAR_M = 40.0  # the vehicle ahead says more of a new track's speed if it is no farther
MOST_LANES_AHEAD = 8
NEAR_STD_MPS, ROOM_STD_MPS = 4.0, 6.0  # deviations of a speed by such a one, or by the room alone
QUEUE_GAP_M, TIME_GAP_S = 7.5, 1.5  # from one vehicle's middle to the next's, standing and driving
UNKNOWN_MPS = 8.0  # deviation of the speed of who was seen once, off the map
TURN_RPS = 0.2  # and of its yaw rate
FIRST_EXISTENCE = 0.6
MOST_EXISTENCE = 0.99
HIT_ODDS = 4.0  # of a detection of a vehicle to one of nothing
UNSURE_LIFE_S = 0.5  # of a track that is not confirmed
AGAIN_S = 0.3  # no longer ago a box in a new track's place was of its vehicle
SURE_HITS = 5  # a track of so many detections is no mistake ...
SURE_S = 0.65  # ... and if the last one was so lately, no double of another
HALF_CAR_M = 2.5  # a position is known where its error is less


def born(time_ns: int, new: Vehicles, std: Floats, first_id: int) -> TrackStates:
    """Returns new tracks (N,) of detections with deviations (N, 3), standing, on no lane."""
    count = len(new)
    boxes = _whole_boxes(new)
    mean = np.column_stack([boxes[:, :2], boxes[:, 6], np.zeros((count, 3))])
    covariance = np.zeros((count, 6, 6))
    cos, sin = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    along, across = std[:, 0] ** 2, std[:, 1] ** 2
    covariance[:, 0, 0] = along * cos**2 + across * sin**2
    covariance[:, 1, 1] = along * sin**2 + across * cos**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = (along - across) * cos * sin
    covariance[:, 2, 2] = std[:, 2] ** 2
    covariance[:, 3, 3] = UNKNOWN_MPS**2
    covariance[:, 4, 4] = TURN_RPS**2
    covariance[:, 5, 5] = motion.STEADY_ACCEL_STD_MPS2**2
    votes = np.zeros((count, CLASSES))
    votes[np.arange(count), new.classes] = new.scores + 1e-3
    number, stamp = np.full(count, -1), np.full(count, time_ns)
    return TrackStates(
        ids=first_id + np.arange(count),
        mean=mean,
        covariance=covariance,
        dims=boxes[:, 2:6].copy(),
        votes=votes,
        score=new.scores.copy(),
        existence=np.full(count, FIRST_EXISTENCE),
        hits=np.ones(count, np.int64),
        wholes=(~np.isnan(new.whole_lengths_m())).astype(np.int64),
        first_ns=stamp,
        last_ns=stamp.copy(),
        lane=number,
        along_m=np.zeros(count),
        off_m=np.zeros(count),
        origin=number.copy(),
        in_view=np.zeros(count),
        cruise=np.full(count, np.nan),
        seen=np.ones(count, np.bool_),
        owner=np.array(new.sources, object),
    )


def begin_again(time_ns: int, born: TrackStates, known: TrackStates) -> None:
    """Exchanges the ids of new tracks and of those seen once, just before, that they lie upon.

    Far away the first box of a vehicle may show a part of it, or lie across the road, so that the
    second one is not its own.
    """
    lately = (time_ns - known.last_ns) / 1e9 <= AGAIN_S
    once = np.flatnonzero(~known.seen & (known.hits == 1) & lately)
    apart_m = apart_of_same(born.boxes, known.boxes[once])
    person = [states.votes.argmax(axis=1) == PERSON for states in (born, known.take(once))]
    apart_m[person[0][:, None] != person[1][None]] = np.inf
    found = nearest(apart_m, np.inf)
    again, before = np.flatnonzero(found >= 0), once[found[found >= 0]]
    born.ids[again], known.ids[before] = known.ids[before], born.ids[again]
    born.first_ns[again] = known.first_ns[before]


def _whole_boxes(new: Vehicles) -> Floats:
    """Returns the boxes of vehicles (N, 7), from end to end where both were seen."""
    boxes, whole = new.boxes.copy(), ~np.isnan(new.ends_m).any(axis=1)
    along_m = new.ends_m[whole].mean(axis=1)
    boxes[whole, 0] += along_m * np.cos(boxes[whole, 6])
    boxes[whole, 1] += along_m * np.sin(boxes[whole, 6])
    boxes[whole, 3] = new.whole_lengths_m()[whole]
    return boxes


def place_on_lanes(
    born: TrackStates,
    known: TrackStates,
    sure: Bools,
    lanes: LaneGraph,
    trips: Floats,
    held: Bools,
) -> None:
    """Gives new tracks their lanes, and speeds as fit the room ahead and who drives there.

    People are on no lane.

    Args:
        born: the new tracks.
        known: all others, located in this frame.
        sure: which of these have a speed that is known.
        lanes: of the map.
        trips: that were seen to take each connection (E,).
        held: see `LaneGraph.held`.
    """
    born.lane, born.along_m, born.off_m = lanes.locate(born.boxes)
    born.lane[born.votes.argmax(axis=1) == PERSON] = -1
    every_lane = np.concatenate([known.lane, born.lane])
    every_along_m = np.concatenate([known.along_m, born.along_m])
    every_mps = np.concatenate(
        [np.where(sure, known.mean[:, 3], np.nan), np.full(len(born), np.nan)]
    )
    for n in np.flatnonzero(born.lane >= 0):
        lane, along_m = born.lane[n], born.along_m[n]
        room_m, leader_mps = np.inf, np.nan
        for here, way_m in _lanes_ahead(lane, along_m, lanes, trips, held):
            ahead = np.flatnonzero((every_lane == here) & (way_m + every_along_m > 0.0))
            if len(ahead):
                leader = ahead[every_along_m[ahead].argmin()]
                room_m = way_m + every_along_m[leader] - QUEUE_GAP_M
                leader_mps = every_mps[leader]
                break
        near = room_m < NEAR_M and not np.isnan(leader_mps)
        if held[lane]:
            to_bar_m = lanes.length_m[lane] - along_m - born.dims[n, 1] / 2 - BAR_M
            room_m = min(room_m, to_bar_m)
        born.mean[n, 3] = _birth_speed(room_m, leader_mps, lanes.speed_mps[lane])
        born.covariance[n, 3, 3] = (NEAR_STD_MPS if near else ROOM_STD_MPS) ** 2


def _lanes_ahead(
    lane: int, along_m: float, lanes: LaneGraph, trips: Floats, held: Bools
) -> Iterator[tuple[int, float]]:
    """Yields a place's lane and the likeliest ones after it, and the way to the start of each.

    As far as `NEAR_M`, and not past a light that holds.
    """
    way_m = -along_m
    for _ in range(MOST_LANES_AHEAD):
        yield lane, way_m
        way_m += lanes.length_m[lane]
        way = likeliest(lane, lanes.leads, trips)
        if way < 0 or held[lane] or way_m >= NEAR_M:
            return
        lane = int(lanes.followers[way])


def _birth_speed(room_m: float, leader_mps: float, limit_mps: float) -> float:
    """Returns how fast a vehicle may be with so much room before it would have to stand.

    By Newell's simplified car following (2002) the room in a time gap; no slower than the vehicle
    ahead, whose speed is NaN where it is not known.
    """
    return float(min(np.fmax(max(room_m, 0.0) / TIME_GAP_S, leader_mps), limit_mps))


def raised_existence(existence: Floats) -> Floats:
    """Returns the raised existence (N,) of tracks that were detected once more."""
    odds = existence * HIT_ODDS
    return np.asarray(np.minimum(odds / (odds + 1 - existence), MOST_EXISTENCE))


def lower_existence(
    states: TrackStates,
    time_ns: int,
    dt_s: float,
    visible: SightLines | None,
    config: TrackingConfig,
) -> None:
    """Lowers the existence of tracks that were not detected, by how visible their place was.

    A track ends where another one was detected, but for those that were seen themselves just
    before: these are not published, and end soon unless they are detected again.
    """
    missed = np.flatnonzero(~states.seen)
    if not len(missed):
        return
    existence = states.existence[missed]
    if visible is None:
        existence = existence * np.exp(-dt_s / config.blind_life_s)
    else:
        plain = visible.plain(states.boxes[missed])
        states.in_view[missed] = plain
        lives_per_s = (1 - plain) / config.shadow_life_s + plain / config.empty_life_s
        existence = existence * np.exp(-dt_s * lives_per_s)
    unsure = states.hits[missed] < config.confirm_hits
    existence = existence * np.where(unsure, np.exp(-dt_s / UNSURE_LIFE_S), 1.0)
    existence[(time_ns - states.last_ns[missed]) / 1e9 > config.max_coast_s] = 0.0
    double = overlapping(states.boxes[missed], states.boxes[states.seen])
    is_sure = states.hits[missed] >= SURE_HITS
    is_sure &= (time_ns - states.last_ns[missed]) / 1e9 <= SURE_S
    states.in_view[missed[double]] = 1.0
    existence[double] *= np.where(is_sure[double], np.exp(-dt_s / config.empty_life_s), 0.0)
    states.existence[missed] = existence


def position_known(states: TrackStates, along_std_m: Floats) -> Floats:
    """Returns the probability (N,) that a vehicle is where its track says, of some deviation."""
    return np.asarray(states.existence * (1 - states.in_view) * _within(along_std_m))


def _within(std_m: Floats) -> Floats:
    """Returns the probability (N,) of an error of less than half a car, normally distributed.

    By the logistic approximation of the normal distribution (Bowling et al. 2009).
    """
    t = HALF_CAR_M / np.maximum(std_m, 1e-3)
    return np.asarray(2 / (1 + np.exp(-np.minimum(1.5976 * t + 0.07056 * t**3, 700.0))) - 1)
