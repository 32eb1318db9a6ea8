"""Birth of tracks: what is known of a vehicle that was detected once."""

from __future__ import annotations

import numpy as np

from perception.arrays import Floats
from perception.detector import Vehicles
from perception.tracking import motion
from perception.tracking.association import PERSON
from perception.tracking.lane_graph import LaneGraph
from perception.tracking.states import TrackStates

NEIGHBOUR_M = 40.0  # who is nearer on a lane tells how fast a new one is likely to be
NEIGHBOUR_STD_MPS = 9.0
UNKNOWN_MPS = 8.0  # deviation of the speed of who was seen once, off the map
TURN_RPS = 0.2  # and of its yaw rate
FIRST_EXISTENCE = 0.6


def born(time_ns: int, new: Vehicles, std: Floats, first_id: int) -> TrackStates:
    """Returns new tracks (N,) of detections with deviations (N, 3), standing, on no lane."""
    count = len(new)
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
    covariance[:, 5, 5] = motion.STEADY_ACCEL_STD_MPS2**2
    votes = np.zeros((count, 4))
    votes[np.arange(count), new.classes] = new.scores + 1e-3
    number, stamp = np.full(count, -1), np.full(count, time_ns)
    return TrackStates(
        ids=first_id + np.arange(count),
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


def place_on_lanes(born: TrackStates, known: TrackStates, lanes: LaneGraph) -> None:
    """Gives new tracks their lanes, and the speed of the nearest known one there, or the lane's.

    People are on no lane.
    """
    born.lane, born.along_m, born.off_m = lanes.locate(born.boxes)
    born.lane[born.votes.argmax(axis=1) == PERSON] = -1
    for n in np.flatnonzero(born.lane >= 0):
        near = np.flatnonzero(known.lane == born.lane[n])
        gap_m = np.abs(known.along_m[near] - born.along_m[n])
        is_alone = not len(near) or gap_m.min() > NEIGHBOUR_M
        limit_mps = lanes.speed_mps[born.lane[n]]
        likely = limit_mps if is_alone else known.mean[near[gap_m.argmin()], 3]
        born.mean[n, 3] = likely
        born.covariance[n, 3, 3] = NEIGHBOUR_STD_MPS**2
