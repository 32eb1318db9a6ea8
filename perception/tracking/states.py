"""The tracker's state of each track, as columns."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from perception.arrays import Bools, Floats, Ints
from protocol.messages import ObjectClass

CLASSES = len(ObjectClass)


@dataclass(slots=True, eq=False)
class TrackStates:
    """The states of N tracks; see `motion` for `mean` and `covariance`.

    `dims` (N, 4) are z, length, width, height, `votes` (N, classes) detections by class, `hits` all
    detections, `wholes` those that showed both ends. `lane`, `along_m` and `off_m` are as of
    `LaneGraph.locate` in this frame; `origin` is the lane that a track was on for sure before, -1
    for none. `owner` is the agent whose poses a track follows, "lidar" for none; `seen` whether it
    was detected in this frame, else `in_view` how surely its place was in plain view. `cruise` is
    the share of the speed allowed at which its driver drives where nothing is in the way, NaN if
    unknown.
    """

    ids: Ints
    mean: Floats
    covariance: Floats
    dims: Floats
    votes: Floats
    score: Floats
    existence: Floats
    hits: Ints
    wholes: Ints
    first_ns: Ints
    last_ns: Ints
    lane: Ints
    along_m: Floats
    off_m: Floats
    origin: Ints
    in_view: Floats
    cruise: Floats
    seen: Bools
    owner: np.ndarray

    @classmethod
    def none(cls) -> TrackStates:
        """Returns no tracks."""
        whole, real = np.zeros(0, np.int64), np.zeros(0)
        return cls(
            ids=whole,
            mean=np.zeros((0, 6)),
            covariance=np.zeros((0, 6, 6)),
            dims=np.zeros((0, 4)),
            votes=np.zeros((0, CLASSES)),
            score=real,
            existence=real,
            hits=whole,
            wholes=whole,
            first_ns=whole,
            last_ns=whole,
            lane=whole,
            along_m=real,
            off_m=real,
            origin=whole,
            in_view=real,
            cruise=real,
            seen=np.zeros(0, np.bool_),
            owner=np.zeros(0, object),
        )

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: Ints | Bools) -> TrackStates:
        """Returns some of them, by index or mask."""
        return TrackStates(*(getattr(self, one.name)[chosen] for one in fields(self)))

    def __add__(self, other: TrackStates) -> TrackStates:
        names = [one.name for one in fields(self)]
        return TrackStates(*(np.concatenate([getattr(s, n) for s in (self, other)]) for n in names))

    @property
    def boxes(self) -> Floats:
        """Returns them as boxes (N, 7)."""
        return np.concatenate([self.mean[:, :2], self.dims, self.mean[:, 2:3]], axis=1)
