"""The agents of a folder of scans: their clouds, poses and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from protocol.errors import ConfigError
from protocol.geometry import SE3, Floats
from protocol.scans import PointCloud
from recording.foreign_scans.alignment import refined
from recording.foreign_scans.folder import agent_name, scans_in, sensors_in
from recording.foreign_scans.poses import Track, read_extrinsics, read_poses
from sensing.point_files import read_points

_STAMP_DIGITS = 16  # of a file's name that is a time in ns: what is shorter is a number
_STAMP_OFF_S = 0.05  # half a revolution


@dataclass(frozen=True, slots=True, eq=False)
class Agent:
    """An agent with clouds from one sensor, or from several that are merged in the vehicle's frame.

    `files` has those of a frame together, by sensor; `mounts` are `vehicle_SE3_sensor`.
    """

    name: str
    files: list[dict[str, Path]]
    mounts: dict[str, SE3]
    track: Track

    def cloud(self, number: int) -> PointCloud:
        """Returns the points of a frame's files in the frame of the sensor, or of the vehicle.

        Raises:
            ConfigError: a file cannot be read.
        """
        parts = [
            (self.mounts[name], read_points(path)) for name, path in self.files[number].items()
        ]
        points = [mount.apply(cloud.points).astype(np.float32) for mount, cloud in parts]
        shade = [cloud.intensity for _, cloud in parts]
        return PointCloud(np.concatenate(points), np.concatenate(shade))

    def pose(self, number: int) -> Floats:
        """Returns the pose (6,) of a frame's files; constant for a stationary sensor."""
        return np.asarray(self.track.poses[number if len(self.track.poses) > 1 else 0])

    @property
    def times_s(self) -> Floats | None:
        """When each frame was (N,); None if not given, or of the one pose alone."""
        times_s = self.track.times_s
        return times_s if times_s is not None and len(times_s) == len(self.files) else None

    def moved(self, by: Floats) -> Agent:
        """Returns the agent with its poses moved by x, y, z in m and yaw in rad (4,)."""
        shift = np.array([*by[:3], 0.0, 0.0, by[3]])
        return replace(self, track=replace(self.track, poses=self.track.poses + shift))


@dataclass(frozen=True, slots=True)
class Source:
    """User input: a folder of clouds, poses, and sensor mounts if there are several.

    With `refine`, that is a first guess; see `recording.foreign_scans.alignment`.
    """

    scans: Path
    poses: Path
    extrinsics: Path | None = None
    sensors: Sequence[str] = ()
    refine: bool = False


def agents_of(source: Source) -> list[Agent]:
    """Returns the agents, sorted; all have equally many frames.

    Raises:
        ConfigError: files are missing or wrong, or do not fit one another.
    """
    if source.extrinsics is None:
        groups = {
            name: [{"": file} for file in files] for name, files in scans_in(source.scans).items()
        }
        mounts = {"": SE3.identity()}
    else:
        mounts = read_extrinsics(source.extrinsics, source.sensors)
        by_sensor = sensors_in(source.scans, list(mounts))
        if source.refine:
            first = {
                name: read_points(files[0]).points.astype(np.float64)
                for name, files in by_sensor.items()
            }
            mounts = refined(mounts, first)
        rows = zip(*by_sensor.values(), strict=True)
        frames = [dict(zip(by_sensor, row, strict=True)) for row in rows]
        groups = {agent_name(source.scans): frames}
    tracks = read_poses(source.poses)
    agents = [
        Agent(
            name, files, mounts, _timed(_track_of(name, tracks, len(groups), source.poses), files)
        )
        for name, files in sorted(groups.items())
    ]
    for agent in agents:
        _check(agent, len(agents[0].files), source.poses)
    return agents


def check_clocks(agents: Sequence[Agent], period_s: float, path: Path) -> None:
    """Checks that agents' frames are synchronous, by the times of their poses.

    Raises:
        ConfigError: the times of a frame are more than half a period apart.
    """
    timed = [agent for agent in agents if agent.times_s is not None]
    for other in timed[1:]:
        assert timed[0].times_s is not None
        assert other.times_s is not None
        apart = np.abs(other.times_s - timed[0].times_s) > period_s / 2
        if apart.any():
            raise ConfigError(
                f"{path}: agents {timed[0].name} and {other.name} have other times in frame "
                f"{int(apart.argmax())}: all need one clock"
            )


def _track_of(name: str, tracks: Mapping[str, Track], agents: int, path: Path) -> Track:
    if name in tracks:
        return tracks[name]
    if agents == 1 and len(tracks) == 1:
        return next(iter(tracks.values()))
    raise ConfigError(
        f"{path}: has no poses of the agent {name!r}; it has those of "
        f"{', '.join(repr(known) for known in tracks)}. With several agents, a table needs the "
        "column agent, or a folder has one for each"
    )


def _timed(track: Track, files: Sequence[Mapping[str, Path]]) -> Track:
    """Picks the poses of the times that files are named by, in ns, if all are named so."""
    stems = [next(iter(of_frame.values())).name.split(".")[0] for of_frame in files]
    if not all(stem.isdigit() and len(stem) >= _STAMP_DIGITS for stem in stems):
        return track
    return track.at(np.array([int(stem) / 1e9 for stem in stems]), _STAMP_OFF_S) or track


def _check(agent: Agent, frames: int, path: Path) -> None:
    poses = len(agent.track.poses)
    if len(agent.files) != frames:
        raise ConfigError(
            f"agent {agent.name} has {len(agent.files)} scans, others have {frames}: all need "
            "equally many"
        )
    if poses not in (1, frames):
        raise ConfigError(
            f"{path}: has {poses} poses for the {frames} scans of {agent.name}; needs as many, or "
            "one if it stood still; poses with times may be more, for files named by times in ns "
            f"that are within {_STAMP_OFF_S:g} s of one"
        )
