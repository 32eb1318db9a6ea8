"""Writes clouds of agents as an MCAP recording over an open ground, as if they were a run."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
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
from recording.limits import MAX_MOUNT_HEIGHT_M
from recording.mcap.format import next_file
from recording.mcap.writer import McapWriter
from sensing.config import UploadConfig

OPEN_GROUND = "open-ground"
BEYOND_M = 100.0
_NEAR_M, _FAR_M = 2.5, 15.0  # around a vehicle: beyond its own body, where most beams hit ground
_LOW_M, _HIGH_M, _BIN_M = -8.0, 0.0, 0.05
_STEP_M = 2.0  # between the points of a ground's middle
_FASTEST_MPS = 60.0
_GREEN = "G"  # the one state of a signal that nobody minds


def height_over_ground_m(cloud: PointCloud, map_SE3_sensor: SE3) -> float:
    """Returns how high a sensor is over the ground, which most of what is near it belongs to.

    0 where it sees nothing below it.
    """
    level = cloud.points @ map_SE3_sensor.rotation.T
    away_m = np.hypot(level[:, 0], level[:, 1])
    near = level[(away_m > _NEAR_M) & (away_m < _FAR_M), 2]
    counts, edges = np.histogram(near, np.arange(_LOW_M, _HIGH_M + _BIN_M / 2, _BIN_M))
    if not counts.any():
        return 0.0
    around = np.convolve(counts, np.ones(3), "same")
    best = int(around.argmax())
    within = (near > edges[max(best - 1, 0)]) & (near < edges[min(best + 2, len(edges) - 1)])
    return -float(np.median(near[within]))


def open_ground(ways: Mapping[str, Floats], *, width_m: float) -> RoadMap:
    """Returns a map with one lane along each way, so broad that all that matters lies on it.

    Its height is that of the way, and so is its direction, which vehicles along it have as well.
    No lane leads to the signal, so that none is counted.

    Args:
        ways: poses (N, 6) on the ground by name, in the order in which they were passed.
        width_m: of the ground; before and behind a way it goes on for `BEYOND_M`.
    """
    lanes = [_lane(f"{OPEN_GROUND}-{name}", poses, width_m) for name, poses in ways.items()]
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


def _lane(name: str, poses: Floats, width_m: float) -> Lane:
    middle = [poses[0, :3]]
    for place in poses[1:, :3]:
        if np.hypot(*(place - middle[-1])[:2]) >= _STEP_M:
            middle.append(place)
    line = np.stack([_beyond(poses[0], -BEYOND_M), *middle, _beyond(poses[-1], BEYOND_M)])
    return Lane(
        id=name,
        edge=name,
        width_m=width_m,
        speed_mps=_FASTEST_MPS,
        length_m=float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum()),
        centreline=[(float(x), float(y), float(z)) for x, y, z in line],
    )


def _beyond(pose: Floats, ahead_m: float) -> Floats:
    """Returns a place (3,) ahead of a pose, at its height."""
    return pose[:3] + ahead_m * np.array([np.cos(pose[5]), np.sin(pose[5]), 0.0])


PROCESS = vehicle_instances(1)[0].id
STEM = "scans"
_SIZE_M = {"length_m": 4.5, "width_m": 1.8, "height_m": 1.5}  # a usual car
_STD_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class ImportedScans:
    """Agents with the height of each of them over the ground, and how many frames they play."""

    agents: Sequence[Agent]
    heights_m: dict[str, float]
    frames: int

    @classmethod
    def of(
        cls, agents: Sequence[Agent], frames: int | None, height_m: float | None
    ) -> ImportedScans:
        """Finds the ground below each agent, unless it is told how high they are over it.

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
        """Returns the simulated time of each frame: as told, else by the period."""
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
        said = [
            self._item("state", state, tls=self._tls),
            self._item("tick", _empty_tick(frame, now_ns)),
            self._item("roster", roster, region=self._region, process=PROCESS),
        ]
        number = self._imported.number(frame)
        for agent in self._imported.agents:
            where = {"region": self._region, "process": PROCESS, "agent": agent.name}
            scan = self._scan(agent, number).model_copy(update=about)
            self.empty += not scan.points
            said += [
                self._item("pose", self._pose(agent, number).model_copy(update=about), **where),
                self._item("scan", scan, **where, chunk="0"),
            ]
        return said

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
