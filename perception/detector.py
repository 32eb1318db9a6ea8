"""Interface of all detectors: input cloud, output vehicles.

`PluginDetector` holds a detector of another package to this interface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.arrays import Bools, Bytes, Floats, Floats32, Ints
from perception.config import DetectionConfig
from perception.object_classes import classes_by_size
from perception.roadway import Placed, Roadway, merge
from protocol.messages import ObjectClass
from protocol.plugins import Plugin

LIDAR = "lidar"


@dataclass(frozen=True, slots=True, eq=False)
class Vehicles:
    """Boxes (N, 7) in the map frame: x, y, z of the centre, length, width, height, yaw.

    `classes` (N,) are of `ObjectClass`; `scores` is (N,), from 0 to 1. A source is "lidar" or the
    agent whose own pose it is; then `position_std_m` (N,) is how far that may be off. `ends_m`
    (N, 2) are where the vehicle's rear and front were seen, along from the box's centre; NaN where
    that is unknown.
    """

    boxes: Floats
    scores: Floats
    sources: list[str]
    position_std_m: Floats
    classes: Bytes
    ends_m: Floats

    @classmethod
    def from_lidar(cls, boxes: Floats, scores: Floats, classes: Bytes | None = None) -> Vehicles:
        """Returns vehicles detected by LiDAR; without classes given, by their sizes."""
        classes = classes_by_size(boxes[:, 3:6]) if classes is None else classes
        unseen = np.full((len(boxes), 2), np.nan)
        return cls(boxes, scores, [LIDAR] * len(boxes), np.zeros(len(boxes)), classes, unseen)

    def __len__(self) -> int:
        return len(self.boxes)

    def whole_lengths_m(self) -> Floats:
        """Returns the lengths (N,) of what was seen from end to end or reports itself, else NaN."""
        reports = np.array([source != LIDAR for source in self.sources], np.bool_)
        return np.where(reports, self.boxes[:, 3], self.ends_m[:, 1] - self.ends_m[:, 0])

    def take(self, chosen: Ints | Bools) -> Vehicles:
        """Returns some of them, by index or mask, in the order of the indices."""
        indices = np.arange(len(self))[chosen]
        return Vehicles(
            self.boxes[indices],
            self.scores[indices],
            [self.sources[i] for i in indices],
            self.position_std_m[indices],
            self.classes[indices],
            self.ends_m[indices],
        )

    def __add__(self, other: Vehicles) -> Vehicles:
        return Vehicles(
            np.concatenate([self.boxes, other.boxes]),
            np.concatenate([self.scores, other.scores]),
            self.sources + other.sources,
            np.concatenate([self.position_std_m, other.position_std_m]),
            np.concatenate([self.classes, other.classes]),
            np.concatenate([self.ends_m, other.ends_m]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in the map frame, with the road's height below each, in the parts they came in.

    A detector has to look at both kinds of parts; `points_over_road` joins them.

    Attributes:
        near: a part for each chunk that still has the ground in it. Empty where all agents remove
            it: with upload filter `foreground`, which some upload policies imply.
        bare: a part for each chunk that was freed of ground and background by its sender. Empty
            without that filter, as by default. A part may hold no points at all.
        sensors: (P, 3) places that each part was seen from, map frame, m; `near` first.
    """

    near: Sequence[Placed]
    bare: Sequence[Placed]
    sensors: Floats

    def points_over_road(self) -> tuple[Floats32, Floats32]:
        """Returns all points (N, 3), map frame, in m, and their heights over the road (N,) in m."""
        points, road_m = merge([*self.near, *self.bare])
        return points, points[:, 2] - road_m


class Stage(Protocol):
    """Times a stage by its name."""

    def __call__(self, name: str) -> AbstractContextManager[None]:
        """Returns a context manager that times the stage."""


def untimed(name: str) -> AbstractContextManager[None]:  # noqa: ARG001 - as `Stage` has it
    """Times nothing."""
    return nullcontext()


class Detector(Protocol):
    """Finds vehicles; keeps nothing from one cloud to the next."""

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """Returns the vehicles in a cloud, map frame; the same for the same cloud and state."""


DetectorMaker = Callable[[DetectionConfig, Roadway], Detector]


@dataclass(frozen=True, slots=True, eq=False)
class PluginDetector:
    """Wraps a plug-in detector and checks its output in each frame."""

    plugin: Plugin
    detector: Detector

    @classmethod
    def of(cls, plugin: Plugin, config: DetectionConfig, roadway: Roadway) -> PluginDetector:
        """Makes the detector for a road.

        Raises:
            ConfigError: the plug-in refuses its settings or makes no detector.
        """
        return cls(plugin, plugin.make("detect", config, roadway))

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """See `perception.detector.Detector.detect`.

        Raises:
            ConfigError: what the plug-in returned are no vehicles.
        """
        return checked_vehicles(self.plugin, self.detector.detect(cloud, rng, stage))


def checked_vehicles(plugin: Plugin, found: object) -> Vehicles:
    """Checks the vehicles that a plug-in returned.

    Raises:
        ConfigError: these are no vehicles.
    """
    if not isinstance(found, Vehicles):
        raise plugin.wrong(f"found a {type(found).__name__}, must find Vehicles")
    count = len(found.boxes)
    numbers = found.scores, found.position_std_m, found.classes, found.ends_m
    shapes = [found.boxes.shape, *(one.shape for one in numbers)]
    if shapes != [(count, 7), *[(count,)] * 3, (count, 2)] or len(found.sources) != count:
        raise plugin.wrong(
            f"found boxes {shapes[0]}, scores {shapes[1]}, position_std_m {shapes[2]}, classes "
            f"{shapes[3]}, ends_m {shapes[4]} and {len(found.sources)} sources; must be (N, 7), "
            "(N,), (N,), (N,), (N, 2) and N"
        )
    if not (np.isfinite(found.boxes).all() and np.isfinite(found.scores).all()):
        raise plugin.wrong("found a box or a score that is no finite number")
    rear_m, front_m = found.ends_m.T
    if np.isinf(found.ends_m).any() or (rear_m >= front_m).any():
        raise plugin.wrong("found ends_m that are infinite, or a rear that is not behind the front")
    if not ((found.scores >= 0) & (found.scores <= 1)).all():
        raise plugin.wrong("found a score outside 0 to 1")
    if not np.isin(found.classes, list(ObjectClass)).all():
        raise plugin.wrong(
            f"found classes {np.unique(found.classes).tolist()}; those of ObjectClass are "
            f"0 to {len(ObjectClass) - 1}"
        )
    return found
