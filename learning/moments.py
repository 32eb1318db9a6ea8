"""What a labelled moment holds, however it is stored: scans, where they were taken, the truth."""

from __future__ import annotations

from dataclasses import dataclass

from perception.arrays import Floats, Floats32, Ints
from protocol.geometry import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One LiDAR's scan: points (N, 3) in the sensor frame.

    `map_SE3_sensor` is what the agent believes, `own` the index of the vehicle that carries the
    sensor among the moment's boxes; None at the roadside.
    """

    agent: str
    points: Floats32
    map_SE3_sensor: SE3
    own: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """All scans of one moment at one junction, and all vehicles there.

    `boxes` (M, 7) are as in `perception.detector.Vehicles`, in the map frame; `points_on` (S, M)
    counts the returns of each shot that came from each vehicle.
    """

    network: str
    frame: int
    shots: list[Shot]
    boxes: Floats
    points_on: Ints
