"""Pairing of a frame's detections with tracks.

An agent's own pose is that of its track; all else is assigned at once (`association`); what is left
at the place of a track is a part of it; then an older track takes back a detection that a younger
one holds at its place.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.detector import LIDAR, Vehicles
from perception.tracking import motion
from perception.tracking.association import associate, is_person
from perception.tracking.places import is_inside, is_same
from perception.tracking.states import TrackStates

POSE_JUMP_M = 25.0  # an agent that is farther from its track is somewhere else: a new track
RECENT_S = 0.5  # a track seen so lately is still there
RECENT_HITS = 3  # and one seen so few times may be the one that was not seen for longer


def pair(
    states: TrackStates,
    observed: Vehicles,
    std: Floats,
    time_ns: int,
    *,
    gate: float,
    jump_std: Floats,
    confirm_hits: int,
    along_lane: Bools,
) -> tuple[Ints, Bools]:
    """Returns for each detection (M,) its track, an index or -1: an agent's own one first.

    And which of them say little of where their tracks are.

    The states of tracks that jump get room for it.

    Args:
        states: predicted for this frame.
        observed: its detections.
        std: their deviations (M, 3), see `motion.deviations`.
        time_ns: of the frame.
        gate: the largest squared distance, see `associate`.
        jump_std: along and across (K, 2), what jumps of each kind may be beyond noise.
        confirm_hits: detections that confirm a track.
        along_lane: which detections (M,) lie along a lane.
    """
    pairs = np.full(len(observed), -1, np.int64)
    if not len(states):
        return pairs, np.zeros(len(observed), np.bool_)
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
    confirmed = states.hits >= confirm_hits
    jumped = _assign(
        states, observed, std, pairs, confirmed, along_lane, jump_std=jump_std, gate=gate
    )
    motion.loosen(states.mean, states.covariance, jumped, motion.JUMPED_STD)
    vague = _keep(states, observed, pairs, confirmed, time_ns)
    _reclaim(states, observed, pairs, time_ns)
    return pairs, vague


def _keep(
    states: TrackStates, observed: Vehicles, pairs: Ints, confirmed: Bools, time_ns: int
) -> Bools:
    """Gives what is left at the place of a track that was seen just now to it; marks it (M,).

    Such a box is beyond the gate since it shows a part of the vehicle, not since it is another.
    """
    vague = np.zeros(len(observed), np.bool_)
    boxes = np.flatnonzero(pairs < 0)
    lately = (time_ns - states.last_ns) / 1e9 <= RECENT_S
    tracks = np.flatnonzero(unpaired(pairs, len(states)) & confirmed & lately)
    if not len(boxes) or not len(tracks):
        return vague
    rows = np.ascontiguousarray(observed.boxes, np.float64)
    person = is_person(states.votes.argmax(axis=1)) > 0
    people = is_person(observed.classes) > 0
    of_box, of_track, apart_m = _at_place(boxes, tracks, rows, states.boxes, people, person)
    for pair in np.argsort(apart_m, kind="stable").tolist():
        box, track = of_box[pair], of_track[pair]
        if pairs[box] < 0 and track in tracks:
            pairs[box], vague[box] = track, True
            tracks = tracks[tracks != track]
    return vague


@njit(
    "Tuple((int64[::1], int64[::1], float64[::1]))(int64[::1], int64[::1], float64[:,::1],"
    " float64[:,::1], boolean[::1], boolean[::1])",
    cache=True,
)
def _at_place(
    boxes: Ints, tracks: Ints, rows: Floats, places: Floats, people: Bools, person: Bools
) -> tuple[Ints, Ints, Floats]:
    """Returns which boxes lie in the place of which tracks, and how far their middles are apart.

    A part of a vehicle may be as small as a person, if it lies within that; a person has no parts.
    """
    of_box, of_track, apart_m = [np.int64(0)], [np.int64(0)], [0.0]
    for m in boxes:
        for n in tracks:
            if people[m] and not person[n]:
                is_there = is_inside(rows[m], places[n])
            else:
                is_there = people[m] == person[n] and is_same(rows[m], places[n])
            if is_there:
                of_box.append(m)
                of_track.append(n)
                apart_m.append(np.hypot(rows[m, 0] - places[n, 0], rows[m, 1] - places[n, 1]))
    return np.array(of_box[1:]), np.array(of_track[1:]), np.array(apart_m[1:])


def _reclaim(states: TrackStates, observed: Vehicles, pairs: Ints, time_ns: int) -> None:
    """Gives detections at the place of a track without one to it, if it is the older one.

    Where a vehicle is seen in parts, a second track begins on it now and then.
    """
    taken = np.flatnonzero(pairs >= 0)
    left = np.flatnonzero(unpaired(pairs, len(states)))
    if not len(taken) or not len(left):
        return
    by_age = left[np.argsort(-states.hits[left], kind="stable")]
    coasted_s = (time_ns - states.last_ns[by_age]) / 1e9
    boxes = np.ascontiguousarray(observed.boxes, np.float64)
    _reclaim_each(by_age, coasted_s, states.boxes, states.hits, taken, boxes, pairs)


@njit(
    "void(int64[::1], float64[::1], float64[:,::1], int64[::1], int64[::1], float64[:,::1],"
    " int64[::1])",
    cache=True,
)
def _reclaim_each(
    by_age: Ints,
    coasted_s: Floats,
    track_boxes: Floats,
    hits: Ints,
    taken: Ints,
    boxes: Floats,
    pairs: Ints,
) -> None:
    """Changes `pairs`: tracks without a detection take the first `taken` one at their place."""
    for index in range(by_age.size):
        n = by_age[index]
        for m in taken:
            other = pairs[m]
            is_younger = hits[other] < hits[n]
            is_doubtful = coasted_s[index] <= RECENT_S or hits[other] <= RECENT_HITS
            if is_younger and is_doubtful and is_same(boxes[m], track_boxes[n]):
                pairs[m] = n
                break


def _assign(
    states: TrackStates,
    observed: Vehicles,
    std: Floats,
    pairs: Ints,
    confirmed: Bools,
    along_lane: Bools,
    *,
    jump_std: Floats,
    gate: float,
) -> Ints:
    """Fills in the tracks of detections that have none yet; returns those that jump."""
    boxes = np.flatnonzero(pairs < 0)
    tracks = np.flatnonzero(unpaired(pairs, len(states)))
    if not len(boxes) or not len(tracks):
        return np.zeros(0, np.int64)
    person = is_person(states.votes[tracks].argmax(axis=1))
    length_m, existence = states.dims[tracks, 1], states.existence[tracks]
    found, jumped = associate(
        states.mean[tracks],
        states.covariance[tracks],
        np.column_stack([length_m, person, existence, confirmed[tracks], states.lane[tracks] >= 0]),
        np.column_stack(
            [observed.boxes[boxes], is_person(observed.classes[boxes]), along_lane[boxes]]
        ),
        std[boxes],
        jump_std,
        gate,
    )
    is_paired = found >= 0
    pairs[boxes[is_paired]] = tracks[found[is_paired]]
    return tracks[found[jumped]]


def unpaired(pairs: Ints, tracks: int) -> Bools:
    """Marks the tracks that no detection belongs to."""
    result = np.ones(tracks, np.bool_)
    result[pairs[pairs >= 0]] = False
    return result
