"""Vehicles that were found, before they are named and counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.arrays import Bools, Floats, Ints

LIDAR = "lidar"


@dataclass(frozen=True, slots=True, eq=False)
class Vehicles:
    """Boxes (N, 7) in the map frame: x, y, z of the centre, length, width, height, yaw.

    `scores` is (N,), from 0 to 1. A source is "lidar" or the agent whose own pose it is; then
    `position_std_m` (N,) is how far that may be off.
    """

    boxes: Floats
    scores: Floats
    sources: list[str]
    position_std_m: Floats

    @classmethod
    def from_lidar(cls, boxes: Floats, scores: Floats) -> Vehicles:
        """Returns vehicles that points gave away."""
        return cls(boxes, scores, [LIDAR] * len(boxes), np.zeros(len(boxes)))

    def __len__(self) -> int:
        return len(self.boxes)

    def take(self, chosen: Ints | Bools) -> Vehicles:
        """Returns some of them, by index or mask, in the order of the indices."""
        indices = np.arange(len(self))[chosen]
        return Vehicles(
            self.boxes[indices],
            self.scores[indices],
            [self.sources[i] for i in indices],
            self.position_std_m[indices],
        )

    def __add__(self, other: Vehicles) -> Vehicles:
        return Vehicles(
            np.concatenate([self.boxes, other.boxes]),
            np.concatenate([self.scores, other.scores]),
            self.sources + other.sources,
            np.concatenate([self.position_std_m, other.position_std_m]),
        )
