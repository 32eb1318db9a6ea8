"""Writes clouds of agents as an MCAP recording of a run on a synthetic open ground."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from perception.detector import LIDAR
from protocol.codec import encode_cloud
from protocol.errors import CodecError, ConfigError
from protocol.geometry import SE3, Floats
from protocol.inbox import Envelope
from protocol.instances import vehicle_instances
from protocol.messages import AgentPose, Equipment, Message, Roster, Scan, Setup, SignalState, Tick
from protocol.messages.fields import Id
from protocol.roadmap import Intersection, Lane, PlanPhase, RoadMap, Signal
from protocol.scans import PointCloud
from protocol.wire import encode
from recording.foreign_scans.agents import Agent
from recording.foreign_scans.ground import Ground, plane_below
from recording.limits import MAX_MOUNT_HEIGHT_M
from recording.mcap.format import next_file
from recording.mcap.writer import McapWriter
from sensing.config import UploadConfig

OPEN_GROUND = "open-ground"
BEYOND_M = 100.0
_STEP_M, _BEYOND_STEP_M = 2.0, 5.0  # between the points of a way, and beyond its ends
_APART_M = 15.0  # scans from which the ground is estimated
_FALLS_M, _NARROWEST_M = 0.2, 1.5  # of a lane to one side; what it is cut into
_FASTEST_MPS = 60.0
_GREEN = "G"  # the one state of a placeholder signal


def height_over_ground_m(cloud: PointCloud, map_SE3_sensor: SE3) -> float:
    """Returns the height of a sensor over the ground, the plane with most points near it.

    0 where it sees nothing below it.
    """
    upright = cloud.points.astype(np.float64) @ map_SE3_sensor.rotation.T
    return -float(plane_below(upright)[0])


def ground_of(
    scans: Iterable[tuple[Floats, SE3]], ways: Mapping[str, Floats], *, width_m: float
) -> Ground:
    """Returns the ground along paths, poses (N, 6), of this width; for scans see `Ground.of`."""
    return Ground.of(scans, [_line(poses)[:, :2] for poses in ways.values()], width_m)


def scans_along(
    agents: Sequence[Agent], ways: Mapping[str, Floats]
) -> Iterator[tuple[Floats, SE3]]:
    """Yields the agents' scans well apart on their paths: points (N, 3) and `map_SE3_sensor`."""
    for agent in agents:
        for number in _looked_at(ways[agent.name]):
            points = agent.cloud(number).points.astype(np.float64)
            yield points, SE3.from_pose(agent.pose(number))


def _looked_at(poses: Floats) -> list[int]:
    """Returns the numbers of poses (N, 6) that are well apart, as many as show the ground."""
    chosen = [0]
    for number, place in enumerate(poses[:, :2]):
        if np.hypot(*(place - poses[chosen[-1], :2])) >= _APART_M:
            chosen.append(number)
    return chosen


def open_ground(ways: Mapping[str, Floats], ground: Ground, *, width_m: float) -> RoadMap:
    """Returns a map with one lane along each path, so wide that all relevant points lie on it.

    Its direction is that of the path, which vehicles along it have as well. Where the ground falls
    to a side, the lane is cut into narrow ones. No lane leads to the signal, so that none is
    counted.

    Args:
        ways: poses (N, 6) on the ground by name, in the order in which they were passed.
        ground: below the paths and around them.
        width_m: of the lanes; before and behind a path they continue for `BEYOND_M`.
    """
    lanes = [
        lane
        for name, poses in ways.items()
        for lane in _lanes(f"{OPEN_GROUND}-{name}", _line(poses), ground, width_m)
    ]
    x, y, z = np.concatenate([poses[:, :3] for poses in ways.values()]).mean(axis=0).tolist()
    plan = [PlanPhase(duration_s=3600.0, state=_GREEN)]
    return RoadMap(
        name=OPEN_GROUND,
        lanes=lanes,
        intersections=[
            Intersection(
                signal=Signal(tls=OPEN_GROUND, links=[], conflicts=[], plan=plan),
                centre=(x, y, z),
                outline=[],
            )
        ],
    )


def ground_around(cloud: PointCloud, name: str, range_m: float) -> RoadMap:
    """Returns the open ground around a single scan, in whose frame z is up, as far as the range."""
    height_m = height_over_ground_m(cloud, SE3.identity())
    ways = {name: np.array([[0.0, 0.0, -height_m, 0.0, 0.0, 0.0]])}
    scans = [(cloud.points.astype(np.float64), SE3.identity())]
    ground = ground_of(scans, ways, width_m=2 * range_m)
    return open_ground(ways, ground, width_m=2 * range_m)


def _line(poses: Floats) -> Floats:
    """Returns the middle (K, 2) of a path, and of its extension before and behind."""
    middle = [poses[0, :2]]
    for place in poses[1:, :2]:
        if np.hypot(*(place - middle[-1])) >= _STEP_M:
            middle.append(place)
    beyond_m = np.arange(_BEYOND_STEP_M, BEYOND_M + _BEYOND_STEP_M / 2, _BEYOND_STEP_M)[:, None]
    before, behind = (
        pose[:2] + side * beyond_m * [np.cos(pose[5]), np.sin(pose[5])]
        for pose, side in ((poses[0], -1.0), (poses[-1], 1.0))
    )
    return np.concatenate([before[::-1], middle, behind])


def _lanes(name: str, line: Floats, ground: Ground, width_m: float) -> list[Lane]:
    """Returns the lane along a line (K, 2), cut so that none falls to a side by much."""
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    edges = np.stack([ground.height_m(line + left * side * width_m / 2) for side in (-1, 0, 1)])
    strips = min(int(np.ptp(edges, axis=0).max() / _FALLS_M) + 1, int(width_m / _NARROWEST_M) or 1)
    one_m = width_m / strips
    lanes = []
    for number, off_m in enumerate((np.arange(strips) - (strips - 1) / 2) * one_m):
        places = line + left * off_m
        points = np.column_stack([places, ground.height_m(places)])
        lanes.append(
            Lane(
                id=name if strips == 1 else f"{name}-{number}",
                edge=name,
                width_m=one_m,
                speed_mps=_FASTEST_MPS,
                length_m=float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
                centreline=[(float(x), float(y), float(z)) for x, y, z in points],
            )
        )
    return lanes


PROCESS = vehicle_instances(1)[0].id
STEM = "scans"
_SIZE_M = {"length_m": 4.5, "width_m": 1.8, "height_m": 1.5}  # a usual car
_STD_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class ImportedScans:
    """Agents with their heights over the ground, and the number of frames to play."""

    agents: Sequence[Agent]
    heights_m: dict[str, float]
    frames: int

    @classmethod
    def of(
        cls, agents: Sequence[Agent], frames: int | None, height_m: float | None
    ) -> ImportedScans:
        """Finds the ground below each agent, unless their heights over it are given.

        Raises:
            ConfigError: a cloud cannot be read, the first of an agent is empty, or a name or the
                height cannot be.
        """
        if height_m is not None and not 0 <= height_m <= MAX_MOUNT_HEIGHT_M:
            raise ConfigError(f"--height {height_m:g}: must be 0 to {MAX_MOUNT_HEIGHT_M:g} m")
        for agent in agents:
            _check_name(agent.name)
        heights_m: dict[str, float] = {}
        for agent in agents:
            cloud = agent.cloud(0)
            if not len(cloud.points):
                raise ConfigError(f"{next(iter(agent.files[0].values()))}: holds no point")
            found_m = height_over_ground_m(cloud, SE3.from_pose(agent.pose(0)))
            heights_m[agent.name] = found_m if height_m is None else height_m
        return cls(agents, heights_m, frames or len(agents[0].files))

    def ways(self) -> dict[str, Floats]:
        """Returns the poses (N, 6) on the ground below each agent."""
        return {
            agent.name: np.stack([self.ground_pose(agent, n) for n in range(self._numbers)])
            for agent in self.agents
        }

    def ground_pose(self, agent: Agent, number: int) -> Floats:
        """Returns the pose (6,) of an agent's footprint in a frame's files."""
        pose = agent.pose(number).copy()
        pose[2] -= self.heights_m[agent.name]
        return pose

    def number(self, frame: int) -> int:
        """Returns which files a frame plays: after the last, they begin anew."""
        return frame % self._numbers

    def sensor_poses(self) -> Floats:
        """Returns the poses (N, 6) of the first agent's sensor, or vehicle, by frame."""
        return np.stack([self.agents[0].pose(self.number(n)) for n in range(self.frames)])

    @property
    def repeats(self) -> bool:
        """Whether files are played more than once."""
        return self.frames > self._numbers

    def times_ns(self, period_ns: int) -> list[int]:
        """Returns the simulated time of each frame: as given, else by the period."""
        for agent in self.agents:
            if (times_s := agent.times_s) is not None and not self.repeats:
                return [round((time_s - times_s[0]) * 1e9) for time_s in times_s[: self.frames]]
        return [frame * period_ns for frame in range(self.frames)]

    @property
    def _numbers(self) -> int:
        return len(self.agents[0].files)


def _check_name(name: str) -> None:
    if name == LIDAR:
        raise ConfigError(f"agent {name!r}: boxes found in points are named so; rename its folder")
    try:
        TypeAdapter(Id).validate_python(name)
    except ValidationError:
        raise ConfigError(
            f"agent {name!r:.200}: its folder's name must have 1 to 128 visible characters"
        ) from None


def record_scans(imported: ImportedScans, setup: Setup, folder: Path) -> int:
    """Writes the recording of a setup into a folder; returns how many clouds have no point.

    Raises:
        ConfigError: a cloud cannot be read or encoded.
        CpnetError: the disk is full.
    """
    writer = McapWriter(lambda: next_file(folder, STEM), setup, {"source": "scans from elsewhere"})
    try:
        made = _FrameWriter(imported, setup)
        for frame in range(imported.frames):
            for item in made.frame(frame):
                writer.write(item)
            writer.settle(time.monotonic_ns())
    finally:
        writer.close({})
    return made.empty


class _FrameWriter:
    def __init__(self, imported: ImportedScans, setup: Setup) -> None:
        scenario = setup.scenario
        self._imported = imported
        self._region = next(iter(scenario["regions"]))
        self._tls = setup.road_map.intersections[0].tls
        self._upload = UploadConfig.model_validate(scenario["upload"])
        self._times_ns = imported.times_ns(round(scenario["frame_period_s"] * 1e9))
        self._encoded: dict[tuple[str, int], Scan] = {}
        self.empty = 0

    def frame(self, frame: int) -> list[Envelope]:
        """Returns all messages of a frame."""
        now_ns, names = self._times_ns[frame], [agent.name for agent in self._imported.agents]
        about = {"frame": frame, "sim_time_ns": now_ns}
        state = self._state(frame, now_ns)
        roster = Roster(frame=frame, process=PROCESS, agents=names, scanning=names)
        messages = [
            self._item("state", state, tls=self._tls),
            self._item("tick", _empty_tick(frame, now_ns)),
            self._item("roster", roster, region=self._region, process=PROCESS),
        ]
        number = self._imported.number(frame)
        for agent in self._imported.agents:
            where = {"region": self._region, "process": PROCESS, "agent": agent.name}
            scan = self._scan(agent, number).model_copy(update=about)
            self.empty += not scan.points
            messages += [
                self._item("pose", self._pose(agent, number).model_copy(update=about), **where),
                self._item("scan", scan, **where, chunk="0"),
            ]
        return messages

    def _pose(self, agent: Agent, number: int) -> AgentPose:
        return AgentPose(
            frame=0,
            sim_time_ns=0,
            agent=agent.name,
            equipment=Equipment.CAV,
            pose=self._imported.ground_pose(agent, number),
            position_std_m=_STD_M,
            **_SIZE_M,
        )

    def _scan(self, agent: Agent, number: int) -> Scan:
        key = agent.name, number
        known = self._encoded.get(key)
        if known is None:
            known = self._encode(agent, number)
            if self._imported.repeats:
                self._encoded[key] = known
        return known

    def _encode(self, agent: Agent, number: int) -> Scan:
        cloud, begun_ns = agent.cloud(number), time.monotonic_ns()
        try:
            payload = encode_cloud(
                cloud,
                self._upload.max_error_m,
                profile=self._upload.profile,
                intensity=self._upload.intensity,
            )
        except CodecError as error:
            raise ConfigError(f"{next(iter(agent.files[number].values()))}: {error}") from None
        return Scan(
            frame=0,
            sim_time_ns=0,
            agent=agent.name,
            chunk=0,
            chunks=1,
            points=len(cloud.points),
            sensor_pose=agent.pose(number),
            sense_start_ns=begun_ns,
            sense_end_ns=begun_ns,
            encode_end_ns=time.monotonic_ns(),
            payload=np.frombuffer(payload, np.uint8),
        )

    def _state(self, frame: int, now_ns: int) -> SignalState:
        return SignalState(
            frame=frame,
            sim_time_ns=now_ns,
            tls=self._tls,
            state="",
            stage="",
            green="",
            source="",
            earliest_change_ns=now_ns,
        )

    def _item(self, topic: str, message: Message, **parts: str) -> Envelope:
        return Envelope(topic, parts, message, time.monotonic_ns(), encode(message))


def _empty_tick(frame: int, now_ns: int) -> Tick:
    return Tick(
        frame=frame,
        sim_time_ns=now_ns,
        processes=[PROCESS],
        bodies=0,
        agents=[],
        equipment=np.zeros(0, np.uint8),
        hosts=np.zeros(0, np.int32),
        places=np.zeros((0, 2)),
        tiles=np.zeros((0, 2), np.int32),
        since=np.zeros(0, np.int64),
    )
