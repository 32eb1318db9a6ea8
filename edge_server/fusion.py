"""Fusion: merges agents' own poses with detections, and removes duplicates.

Chen et al. 2022 call two detections closer than a vehicle's length duplicates and drop the one
farther from the junction. Lanes are 3.5 m wide, so that a radius of 4.5 m swallows the neighbour in
the next lane of a queue; the default rule looks along and across the vehicle separately. The
paper's radius is the named option.

The entry point of a plug-in (group `cpnet.fusions`) names a `FusionMaker`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edge_server.config import FUSIONS, FusionConfig
from perception.arrays import Bools, Bytes, Floats, Ints
from perception.detector import LIDAR, Vehicles, checked_vehicles
from perception.object_classes import classes_by_size
from perception.roadway import LEVEL_M
from protocol.messages import AgentPose, Equipment, ObjectClass
from protocol.plugins import Plugin

HEIGHT_SLACK = 6.0  # three deviations of a height, which is twice as uncertain as the position
CERTAIN_STD_M = 0.5  # poses better than this determine by themselves which box is the agent's


class Fusion(Protocol):
    """Interface of a fusion: merges the detections of a frame; it is stateless."""

    def fuse(self, found: Vehicles, poses: list[AgentPose]) -> Vehicles:
        """Returns each vehicle once.

        Args:
            found: (N,) boxes of the detector, then those that agents detected on board; map frame,
                in m; empty where nothing was found.
            poses: of the agents that reported them, sorted by agent, roadside units too
                (`Equipment.NONE`); `from_poses` makes vehicles of those that are.
        """


FusionMaker = Callable[[FusionConfig, Floats], Fusion]
"""Makes the fusion of a region from the configuration and its junctions' centres (C, 2 or 3).

The settings of a plug-in are `plugin` of the configuration; a ValueError refuses them.
"""


def fusion_of(config: FusionConfig, centres: Floats) -> Fusion:
    """Makes the fusion that a configuration names.

    Raises:
        ConfigError: the plug-in cannot be imported, refuses its settings or makes no fusion.
    """
    if config.rule in FUSIONS.builtin:
        return _ByRule(config, centres)
    plugin = FUSIONS.load(config.rule)
    return _CheckedFusion(plugin, plugin.make("fuse", config, centres))


@dataclass(frozen=True, slots=True, eq=False)
class _ByRule:
    config: FusionConfig
    centres: Floats

    def fuse(self, found: Vehicles, poses: list[AgentPose]) -> Vehicles:
        """See `Fusion.fuse`."""
        return fuse(found, poses, centres=self.centres, config=self.config)


@dataclass(frozen=True, slots=True, eq=False)
class _CheckedFusion:
    """Checks each frame's result of a plug-in."""

    plugin: Plugin
    fusion: Fusion

    def fuse(self, found: Vehicles, poses: list[AgentPose]) -> Vehicles:
        """See `Fusion.fuse`.

        Raises:
            ConfigError: what the plug-in returned are no vehicles.
        """
        return checked_vehicles(self.plugin, self.fusion.fuse(found, poses))


def fuse(
    found: Vehicles, poses: list[AgentPose], *, centres: Floats, config: FusionConfig
) -> Vehicles:
    """Fuses LiDAR detections with the agents' own poses; the order of either does not matter.

    A pose wins over a LiDAR's box; one that may be metres off, a CV's, stands for the nearest box
    only. Of two boxes the one nearer to a junction's centre (C, 2 or 3) stays. The result has
    poses first, sorted by agent, then boxes, nearest first.
    """
    return join([from_poses(poses) + found], centres=centres, config=config)


def join(parts: Sequence[Vehicles], *, centres: Floats, config: FusionConfig) -> Vehicles:
    """Fuses the vehicles of several edges, as `fuse` does; their order does not matter.

    A pose claims only boxes of parts that lack it: in the others it already has.
    """
    own = _without_twins(parts)
    left = Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))
    for part in parts:
        is_box = np.array([source == LIDAR for source in part.sources], np.bool_)
        found, known = part.take(is_box), set(part.sources) if len(parts) > 1 else set()
        found = found.take(_ranked(found, centres))
        claiming = own.take(np.array([name not in known for name in own.sources], np.bool_))
        left += found.take(~_claimed(claiming, found, config))
    both = own + left.take(_ranked(left, centres))
    gone = np.zeros(len(both), np.bool_)
    same = _same(both.boxes, both.boxes, config) & _alike(both.classes)
    if config.rule != "radius" and (both.classes == ObjectClass.TWO_WHEELER).any():
        same &= _overlap(both.boxes) | ~_with_two_wheeler(both.classes)
    for index in range(len(both)):
        if not gone[index] and both.position_std_m[index] <= CERTAIN_STD_M:
            later = max(len(own), index + 1)
            gone[later:] |= same[index, later:]
    return both.take(~gone)


def _without_twins(parts: Sequence[Vehicles]) -> Vehicles:
    """Returns the agents' poses of all parts without duplicates, sorted by agent."""
    all_of = sum(parts[1:], parts[0])
    first = {name: index for index, name in reversed([*enumerate(all_of.sources)])}
    first.pop(LIDAR, None)
    return all_of.take(np.array([first[name] for name in sorted(first)], np.int64))


def from_poses(poses: list[AgentPose]) -> Vehicles:
    """Returns the vehicles among the agents as detections of themselves, sorted by agent."""
    vehicles = [p for p in poses if p.equipment is not Equipment.NONE]
    vehicles = sorted(vehicles, key=lambda p: p.agent)
    boxes = [
        (
            *p.pose[:2],
            p.pose[2] + p.height_m / 2,
            p.length_m,
            p.width_m,
            p.height_m,
            p.pose[5],
        )
        for p in vehicles
    ]
    rows = np.array(boxes, np.float64).reshape(-1, 7)
    return Vehicles(
        rows,
        np.ones(len(vehicles)),
        [p.agent for p in vehicles],
        np.array([p.position_std_m for p in vehicles], np.float64),
        classes_by_size(rows[:, 3:6]),
        np.full((len(vehicles), 2), np.nan),
    )


def _ranked(found: Vehicles, centres: Floats) -> Ints:
    """Orders boxes by their distance from the nearest centre, then by all their numbers."""
    apart_m = np.linalg.norm(found.boxes[:, None, :2] - centres[:, :2], axis=2)
    distance_m = apart_m.min(axis=1, initial=np.inf)
    keys = [found.scores, *found.boxes.T[::-1], distance_m]
    return np.asarray(np.lexsort(keys))


def _claimed(own: Vehicles, found: Vehicles, config: FusionConfig) -> Bools:
    """Marks the boxes that belong to agents whose poses are uncertain: the nearest for each.

    Pairs are made nearest first, up to a standard deviation more than the rule allows along and
    across, and three of the height: a box on another level is farther by what lies between.
    """
    claimed = np.zeros(len(found), np.bool_)
    is_vehicle = found.classes != ObjectClass.PEDESTRIAN
    pairs: list[tuple[float, int, int]] = []
    for index in range(len(own)):
        std_m = float(own.position_std_m[index])
        if std_m > CERTAIN_STD_M:
            near = _same(own.boxes[index : index + 1], found.boxes, config, slack_m=std_m)[0]
            gaps_m = np.linalg.norm(found.boxes[:, :2] - own.boxes[index, :2], axis=1)
            gaps_m += np.maximum(np.abs(found.boxes[:, 2] - own.boxes[index, 2]) - LEVEL_M, 0.0)
            chosen = np.flatnonzero(near & is_vehicle)
            pairs += [(float(gaps_m[box]), index, int(box)) for box in chosen]
    served: set[int] = set()
    for _, index, box in sorted(pairs):
        if index not in served and not claimed[box]:
            served.add(index)
            claimed[box] = True
    return claimed


def _same(boxes: Floats, others: Floats, config: FusionConfig, *, slack_m: float = 0.0) -> Bools:
    """Whether each of the others (M, 7) is the same vehicle as each of these boxes (N, 7)."""
    x, y, z = (others[:, axis] - boxes[:, axis : axis + 1] for axis in range(3))
    level = np.abs(z) < LEVEL_M + HEIGHT_SLACK * slack_m
    if config.rule == "radius":
        return np.asarray(level & (np.hypot(x, y) < config.duplicate_m + slack_m))
    cos, sin = np.cos(boxes[:, 6:7]), np.sin(boxes[:, 6:7])
    along, across = np.abs(cos * x + sin * y), np.abs(cos * y - sin * x)
    half_m = np.maximum(boxes[:, 3:4], others[:, 3]) / 2  # a part of a lorry lies anywhere in it
    along_m = np.maximum(config.duplicate_m, half_m) + slack_m
    return np.asarray(level & (along < along_m) & (across < config.across_m + slack_m))


def _overlap(boxes: Floats) -> Bools:
    """Whether each of some boxes (N, 7) overlaps each other, along and across the first."""
    x, y = (boxes[:, axis] - boxes[:, axis : axis + 1] for axis in range(2))
    cos, sin = np.cos(boxes[:, 6:7]), np.sin(boxes[:, 6:7])
    long_m, wide_m = ((boxes[:, side : side + 1] + boxes[:, side]) / 2 for side in (3, 4))
    along, across = np.abs(cos * x + sin * y), np.abs(cos * y - sin * x)
    return np.asarray((along < long_m) & (across < wide_m))


def _with_two_wheeler(classes: Bytes) -> Bools:
    """Whether one of two objects (N,) is a two-wheeler: others are a bare metre before it."""
    marked = classes == ObjectClass.TWO_WHEELER
    return np.asarray(marked[:, None] | marked)


def _alike(classes: Bytes) -> Bools:
    """Whether each of some objects (N,) may be the same as each other: people are no vehicles."""
    is_person = classes == ObjectClass.PEDESTRIAN
    return np.asarray(~is_person[:, None] & ~is_person)
