"""Attacks and faults: false data that an agent may send."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from edge_server.frame import Chunk, Frame
from perception.arrays import Floats, Floats32
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment
from protocol.roadmap import RoadMap

CAR_M = (4.5, 1.8, 1.5)
GHOST = "ghost"
GHOST_POINTS = 400
ALONE_M = 6.0  # from any vehicle: nothing is there


class Attack(Protocol):
    """Changes one agent's data in a frame; frames come one after the other."""

    def apply(self, frame: Frame, victim: str) -> Frame:
        """Returns the frame with false data."""


@dataclass(frozen=True, slots=True)
class Displaced:
    """The agent's pose and cloud are moved, in its own frame, and turned."""

    along_m: float = 0.0
    across_m: float = 0.0
    up_m: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    from_frame: int = 0

    def apply(self, frame: Frame, victim: str) -> Frame:
        """See `Attack.apply`."""
        if frame.frame < self.from_frame:
            return frame
        poses = [
            p.model_copy(update={"pose": self._moved(p.pose)}) if p.agent == victim else p
            for p in frame.poses
        ]
        chunks = [
            replace(p, sensor_pose=self._moved(p.sensor_pose), placed=None)
            if p.agent == victim
            else p
            for p in frame.chunks
        ]
        return replace(frame, poses=poses, chunks=chunks)

    def _moved(self, pose: Floats) -> Floats:
        cos, sin = np.cos(pose[5]), np.sin(pose[5])
        moved = np.array(pose)
        moved[0] += cos * self.along_m - sin * self.across_m
        moved[1] += sin * self.along_m + cos * self.across_m
        moved[2] += self.up_m
        moved[3] += np.radians(self.roll_deg)
        moved[5] += np.radians(self.yaw_deg)
        return moved


class Replayed:
    """The cloud of some frames ago, at the agent's present place."""

    def __init__(self, frames_ago: int) -> None:
        self._ago = frames_ago
        self._past: list[list[Chunk]] = []

    def apply(self, frame: Frame, victim: str) -> Frame:
        """See `Attack.apply`."""
        own = [chunk for chunk in frame.chunks if chunk.agent == victim]
        self._past.append(own)
        if not own or len(self._past) <= self._ago or not self._past[-1 - self._ago]:
            return frame
        old = self._past[-1 - self._ago][0]
        now = replace(own[0], points=old.points, returns=old.returns, placed=None)
        return _with(frame, victim, now)


@dataclass(frozen=True, slots=True)
class Emptied:
    """A cloud without a point."""

    def apply(self, frame: Frame, victim: str) -> Frame:
        """See `Attack.apply`."""
        own = [chunk for chunk in frame.chunks if chunk.agent == victim]
        nothing = np.zeros((0, 3), np.float32)
        emptied = [replace(p, points=nothing, returns=0, placed=None) for p in own]
        return _with(frame, victim, *emptied)


@dataclass(frozen=True, slots=True)
class Peopled:
    """A cloud with cars in it, at free places near the agent, that are not there."""

    road_map: RoadMap
    cars: int

    def apply(self, frame: Frame, victim: str) -> Frame:
        """See `Attack.apply`."""
        own = [chunk for chunk in frame.chunks if chunk.agent == victim]
        if not own:
            return frame
        map_SE3_sensor = SE3.from_pose(own[0].sensor_pose)
        places = free_places(self.road_map, frame, own[0].sensor_pose[:2], (8.0, 30.0))
        rng = np.random.default_rng(frame.frame)
        shells = [_shell(place, rng) for place in places[:: max(len(places) // self.cars, 1)]]
        inside = [map_SE3_sensor.inverse().apply(shell) for shell in shells[: self.cars]]
        points = np.concatenate([own[0].points, *inside]).astype(np.float32)
        return _with(frame, victim, replace(own[0], points=points, placed=None))


@dataclass(frozen=True, slots=True)
class GhostReport:
    """One more vehicle with a radio reports a position where nothing stands; `victim` is a post."""

    road_map: RoadMap
    position_std_m: float

    def apply(self, frame: Frame, victim: str) -> Frame:
        """See `Attack.apply`."""
        own = [chunk for chunk in frame.chunks if chunk.agent == victim]
        if not own:
            return frame
        places = free_places(self.road_map, frame, own[0].sensor_pose[:2], (15.0, 35.0))
        if not len(places):
            return frame
        pose = AgentPose(
            frame=frame.frame,
            sim_time_ns=frame.sim_time_ns,
            agent=GHOST,
            equipment=Equipment.CV,
            pose=places[0],
            length_m=CAR_M[0],
            width_m=CAR_M[1],
            height_m=CAR_M[2],
            position_std_m=self.position_std_m,
        )
        poses = sorted([*frame.poses, pose], key=lambda one: one.agent)
        return replace(frame, poses=poses, agents=sorted([*frame.agents, GHOST]))


def free_places(
    road_map: RoadMap, frame: Frame, around_m: Floats, ring_m: tuple[float, float]
) -> Floats:
    """Returns poses (N, 6) along the lanes, so far from a place, without points of a body."""
    poses: list[Floats] = []
    for lane in road_map.lanes:
        for start, end in zip(lane.points[:-1], lane.points[1:], strict=True):
            yaw = float(np.arctan2(end[1] - start[1], end[0] - start[0]))
            steps = np.arange(0.0, float(np.linalg.norm(end - start)), 8.0)[:, None]
            unit = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
            poses += [np.array([*place, 0, 0, yaw]) for place in start + steps * unit]
    every = np.array(poses)
    away_m = np.linalg.norm(every[:, :2] - around_m, axis=1)
    every = every[(ring_m[0] <= away_m) & (away_m <= ring_m[1])]
    bodies = [np.array([pose.pose[:2] for pose in frame.poses]).reshape(-1, 2)]
    for chunk in frame.chunks:
        if chunk.placed is not None:
            over_m = chunk.placed.points[:, 2] - chunk.placed.road_m
            bodies.append(
                chunk.placed.points[(over_m > 0.4) & (over_m < 2.0), :2][::8].astype(float)
            )
    taken = np.concatenate(bodies)
    apart_m = [np.linalg.norm(taken - place[:2], axis=1).min(initial=np.inf) for place in every]
    return np.asarray(every[np.array(apart_m, np.float64) > ALONE_M])


def _shell(pose: Floats, rng: np.random.Generator) -> Floats32:
    """Returns points (N, 3) on the sides and the roof of a car."""
    points = rng.uniform(-0.5, 0.5, (GHOST_POINTS, 3))
    side = rng.integers(0, 3, GHOST_POINTS)
    points[side < 2, side[side < 2]] = rng.choice([-0.5, 0.5], int((side < 2).sum()))
    points[side == 2, 2] = 0.5
    points[:, 2] += 0.5
    local = points * CAR_M
    return SE3.from_pose(pose).apply(local).astype(np.float32)


def _with(frame: Frame, victim: str, *chunks: Chunk) -> Frame:
    others: Sequence[Chunk] = [chunk for chunk in frame.chunks if chunk.agent != victim]
    both = sorted([*others, *chunks], key=lambda chunk: (chunk.agent, chunk.index))
    return replace(frame, chunks=both)
