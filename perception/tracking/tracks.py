"""Tracks: vehicles that keep their id from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.arrays import Bools, Bytes, Floats, Ints
from perception.detector import Vehicles


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tracks (N,) after a frame, in the order of their ids.

    `boxes` (N, 7) are as in `perception.detector.Vehicles`, `speeds_mps` are along the heading,
    `scores` those of the detections in this frame, and for tracks that coast the probability that
    the vehicle is there, `existence`. `coasted_s` is the time since the last detection, 0 in a
    frame with one. Standard deviations are those of the position along the heading and of the
    speed. A source is "lidar" or the agent whose own poses the track follows.
    """

    track_ids: Ints
    boxes: Floats
    speeds_mps: Floats
    yaw_rates_rps: Floats
    position_std_m: Floats
    speed_std_mps: Floats
    scores: Floats
    existence: Floats
    first_seen_ns: Ints
    coasted_s: Floats
    classes: Bytes
    sources: list[str]

    @classmethod
    def none(cls) -> Tracks:
        """Returns no tracks."""
        numbers, empty = np.zeros(0, np.int64), np.zeros(0)
        return cls(
            track_ids=numbers,
            boxes=np.zeros((0, 7)),
            speeds_mps=empty,
            yaw_rates_rps=empty,
            position_std_m=empty,
            speed_std_mps=empty,
            scores=empty,
            existence=empty,
            first_seen_ns=numbers,
            coasted_s=empty,
            classes=np.zeros(0, np.uint8),
            sources=[],
        )

    @classmethod
    def untracked(cls, observed: Vehicles, time_ns: int) -> Tracks:
        """Returns detections of one frame as if each were a track of its own, with the id 0."""
        number, nothing = len(observed), np.zeros(len(observed))
        return cls(
            track_ids=np.zeros(number, np.int64),
            boxes=observed.boxes,
            speeds_mps=nothing,
            yaw_rates_rps=nothing,
            position_std_m=observed.position_std_m,
            speed_std_mps=nothing,
            scores=observed.scores,
            existence=np.ones(number),
            first_seen_ns=np.full(number, time_ns),
            coasted_s=nothing,
            classes=observed.classes,
            sources=observed.sources,
        )

    def __len__(self) -> int:
        return len(self.track_ids)

    def take(self, chosen: Ints | Bools | slice) -> Tracks:
        """Returns some of them, by index or mask, in the order of the indices."""
        indices = np.arange(len(self))[chosen]
        return Tracks(
            track_ids=self.track_ids[indices],
            boxes=self.boxes[indices],
            speeds_mps=self.speeds_mps[indices],
            yaw_rates_rps=self.yaw_rates_rps[indices],
            position_std_m=self.position_std_m[indices],
            speed_std_mps=self.speed_std_mps[indices],
            scores=self.scores[indices],
            existence=self.existence[indices],
            first_seen_ns=self.first_seen_ns[indices],
            coasted_s=self.coasted_s[indices],
            classes=self.classes[indices],
            sources=[self.sources[i] for i in indices],
        )
