"""Existence: how likely a track's vehicle is there, by detections and by what sensors see.

With each detection it rises. Without one it falls: fast where a sensor sees through the place,
slowly in a shadow.
"""

from __future__ import annotations

import numpy as np

from perception.arrays import Floats
from perception.tracking.config import TrackingConfig
from perception.tracking.places import overlapping
from perception.tracking.sightlines import SightLines
from perception.tracking.states import TrackStates

MOST_EXISTENCE = 0.99
HIT_ODDS = 4.0  # of a detection of a vehicle to one of nothing
UNSURE_LIFE_S = 0.5  # of a track that is not confirmed
HALF_CAR_M = 2.5  # a position is known where its error is less


def raised(existence: Floats) -> Floats:
    """Returns the existence (N,) of tracks that were detected once more."""
    odds = existence * HIT_ODDS
    return np.asarray(np.minimum(odds / (odds + 1 - existence), MOST_EXISTENCE))


def lower(
    states: TrackStates,
    time_ns: int,
    dt_s: float,
    visible: SightLines | None,
    config: TrackingConfig,
) -> None:
    """Lowers the existence of who was not detected, by what should have been seen there.

    It ends where another one was detected.
    """
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
    existence[(time_ns - states.last_ns[missed]) / 1e9 > config.max_coast_s] = 0.0
    existence[overlapping(states.boxes[missed], states.boxes[states.seen])] = 0.0
    states.existence[missed] = existence


def known(states: TrackStates, along_std_m: Floats) -> Floats:
    """Returns the probability (N,) that a vehicle is where its track says, of some deviation."""
    return np.asarray(states.existence * (1 - states.in_view) * _within(along_std_m))


def _within(std_m: Floats) -> Floats:
    """Returns the probability (N,) of an error of less than half a car, normally distributed.

    By the logistic approximation of the normal distribution (Bowling et al. 2009).
    """
    t = HALF_CAR_M / np.maximum(std_m, 1e-3)
    return np.asarray(2 / (1 + np.exp(-np.minimum(1.5976 * t + 0.07056 * t**3, 700.0))) - 1)
