"""LiDAR scans of a running CARLA server, while SUMO moves the traffic.

CARLA's world is left-handed: x east, y south, z up; a sensor's x forward, y right, z up. Its angles
are in degrees: yaw clockwise from above, pitch up, roll to the right. Ours is right-handed: x east,
y north; x forward, y left. Mirroring y leads from either to the other.
"""

from __future__ import annotations

import fcntl
import os
import queue
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from perception.arrays import Floats, Floats32, Ints
from protocol.config import Section
from protocol.errors import BusError, ConfigError
from protocol.geometry import SE3
from protocol.messages import Setup
from protocol.scans import RangeScan, ScanPattern
from sensing.config import LidarConfig
from sensing.lidar import Sensed
from sensing.world_view import WorldView


class CarlaConfig(Section):
    """The settings under `lidar.plugin`: the CARLA server that casts scans."""

    host: str = Field("127.0.0.1", description="its machine; that of all agents that share it")
    port: int = Field(2000, ge=1, le=65_535, description="its port for commands")
    timeout_s: float = Field(60.0, gt=0, le=3600, description="how long it may take to answer")
    town: str | None = Field(
        None, description="map to be loaded, such as Town04; null: what is loaded there"
    )
    net_offset_m: tuple[float, float] = Field(
        (0.0, 0.0), description="the net's netOffset, in its <location>: where CARLA's 0, 0 lies"
    )
    blueprints: dict[str, str] = Field(
        {},
        description="by name of the SUMO vType; others look like a car, a van or a bus by their "
        "mesh",
    )


def carla_pose(map_pose: npt.ArrayLike, net_offset_m: tuple[float, float]) -> Floats:
    """Returns x, y, z in m and roll, pitch, yaw in deg (6,), as CARLA has them, of a map pose."""
    x, y, z, roll, pitch, yaw = np.asarray(map_pose, np.float64)
    angles_deg = np.degrees([roll, -pitch, -yaw])
    return np.array([x - net_offset_m[0], net_offset_m[1] - y, z, *angles_deg])


def scan_of(measured: Floats32, pattern: ScanPattern) -> RangeScan:
    """Returns the scan of points (N, 4): x, y, z in CARLA's sensor frame, intensity.

    Each point goes to the beam that its direction is nearest to, and of several the nearest counts;
    what lies more than half a ring beyond the pattern is dropped.
    """
    points = measured[:, :3].astype(np.float64) * [1, -1, 1]
    range_m = np.linalg.norm(points, axis=1)
    known = np.isfinite(range_m) & (range_m > 0)
    points, range_m, intensity = points[known], range_m[known], measured[known, 3]
    rings, columns = _beams(points / range_m[:, None], pattern)
    within = np.flatnonzero((rings >= 0) & (rings < pattern.channels))
    order = within[np.argsort(-range_m[within], kind="stable")]  # the nearest is written last
    planes = np.zeros((2, pattern.channels, pattern.columns), np.float32)
    planes[0, rings[order], columns[order]] = range_m[order]
    planes[1, rings[order], columns[order]] = np.clip(intensity[order], 0, 1)
    return RangeScan(pattern, planes[0], planes[1])


def _beams(directions: Floats, pattern: ScanPattern) -> tuple[Ints, Ints]:
    """Returns ring and column (N,) of unit vectors (N, 3) in our sensor frame."""
    below_deg = pattern.upper_fov_deg - np.degrees(np.arcsin(np.clip(directions[:, 2], -1, 1)))
    span_deg = pattern.upper_fov_deg - pattern.lower_fov_deg
    step_deg = span_deg / (pattern.channels - 1) if pattern.channels > 1 and span_deg else 1.0
    turns = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
    rings, columns = np.rint(below_deg / step_deg), np.rint(turns * pattern.columns)
    return rings.astype(np.int64), columns.astype(np.int64) % pattern.columns


ATTRIBUTES = {
    "channels",
    "range",
    "points_per_second",
    "rotation_frequency",
    "upper_fov",
    "lower_fov",
    "atmosphere_attenuation_rate",
    "dropoff_general_rate",
    "dropoff_intensity_limit",
    "dropoff_zero_intensity",
    "noise_stddev",
}
"""Keys of a scenario's LiDAR that CARLA's has as attributes of the same names."""

_ROLE = "cpnet"
_SKY_M, _APART_M = 1000.0, 20.0  # where spawning never fails for want of room


def load_carla() -> ModuleType:
    """Imports CARLA's package.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import carla
    except ImportError as error:
        raise ConfigError(
            "lidar.source: carla needs CARLA's Python package, of the server's version "
            f"(pip install carla): {error}"
        ) from None
    module: ModuleType = carla
    return module


class CarlaServer:
    """This process's connection to a CARLA server, with bodies of its own.

    During a `turn`, the bodies of all other processes are hidden, so that each process casts in a
    world that it has set up alone.
    """

    def __init__(self, config: CarlaConfig, tick_s: float) -> None:
        """Connects, loads the town and makes the world wait for ticks.

        Raises:
            ConfigError: no answer, or the server is of another version or lacks the town.
        """
        self.carla = load_carla()
        self._config = config
        self._place = f"{config.host}:{config.port}"
        name = f"cpnet-carla-{os.getuid()}-{config.host}-{config.port}.lock"
        self._lock = Path(tempfile.gettempdir()) / name
        self._bodies: dict[str, int] = {}
        with self.turn():
            try:
                self._open(tick_s)
            except RuntimeError as error:
                raise ConfigError(
                    f"CARLA at {self._place} (lidar.plugin.host, port): {error}"
                ) from None

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Waits until no other process of this machine has its turn with the server.

        Raises:
            BusError: the server was lost meanwhile.
        """
        with self._lock.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            try:
                yield
            except RuntimeError as error:
                raise BusError(f"CARLA at {self._place} is lost: {error}") from error

    def blueprint(self, name: str) -> Any:  # noqa: ANN401 - CARLA is untyped
        """Returns a blueprint, marked as this process's.

        Raises:
            ConfigError: the server has no such blueprint.
        """
        try:
            found = self.world.get_blueprint_library().find(name)
        except (IndexError, RuntimeError):
            raise ConfigError(f"CARLA at {self._place} has no blueprint {name!r}") from None
        found.set_attribute("role_name", f"{_ROLE}-{os.getpid()}")
        return found

    def transform(self, pose: Floats | tuple[float, ...]) -> Any:  # noqa: ANN401 - the same
        """Returns the `carla.Transform` of a pose in CARLA's frame, see `carla_pose`."""
        x, y, z, roll, pitch, yaw = map(float, pose)
        rotation = self.carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
        return self.carla.Transform(self.carla.Location(x=x, y=y, z=z), rotation)

    def place(self, poses: Mapping[str, Floats], looks: Mapping[str, str]) -> None:
        """Places exactly these bodies at these poses in CARLA's frame; spawns new ones by `looks`.

        Raises:
            BusError: the server refuses a body.
        """
        command = self.carla.command
        gone = [self._bodies.pop(body) for body in sorted(self._bodies.keys() - poses.keys())]
        self._send([command.DestroyActor(actor) for actor in gone])
        new = sorted(poses.keys() - self._bodies.keys())
        still = command.SetSimulatePhysics(command.FutureActor, False)
        spawned = self._send(
            [
                command.SpawnActor(self.blueprint(looks[body]), self._sky(n)).then(still)
                for n, body in enumerate(new, start=1)
            ]
        )
        self._bodies |= {b: one.actor_id for b, one in zip(new, spawned, strict=True)}
        self.move({self._bodies[body]: self.transform(pose) for body, pose in poses.items()})

    def move(self, transforms: Mapping[int, Any]) -> None:
        """Moves actors, by number.

        Raises:
            BusError: one of them is gone.
        """
        command = self.carla.command.ApplyTransform
        self._send([command(actor, where) for actor, where in sorted(transforms.items())])

    def hide(self) -> None:
        """Hides all bodies."""
        self.move(dict.fromkeys(self._bodies.values(), self._sky(0)))

    def clear(self) -> None:
        """Destroys all bodies."""
        self._send([self.carla.command.DestroyActor(actor) for actor in self._bodies.values()])
        self._bodies = {}

    def _send(self, commands: list[Any]) -> list[Any]:
        responses = self.client.apply_batch_sync(commands, False) if commands else []
        for response in responses:
            if response.error:
                raise BusError(f"CARLA at {self._place}: {response.error}")
        return list(responses)

    def _open(self, tick_s: float) -> None:
        self.client = self.carla.Client(self._config.host, self._config.port)
        self.client.set_timeout(self._config.timeout_s)
        ours, theirs = self.client.get_client_version(), self.client.get_server_version()
        if ours != theirs:
            raise ConfigError(
                f"CARLA at {self._place} is version {theirs}, the package {ours}; they must be one"
            )
        self.world = self.client.get_world()
        town = self._config.town
        if town is not None and self.world.get_map().name.rpartition("/")[2] != town:
            self.world = self.client.load_world(town)
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, tick_s
        self.world.apply_settings(settings)
        left = [actor.id for actor in self.world.get_actors() if _is_left(actor)]
        self._send([self.carla.command.DestroyActor(actor) for actor in left])

    def _sky(self, number: int) -> Any:  # noqa: ANN401 - CARLA is untyped
        return self.transform(
            (_APART_M * (number % 100), 0, _SKY_M + _APART_M * (number // 100), 0, 0, 0)
        )


def _is_left(actor: Any) -> bool:  # noqa: ANN401 - CARLA is untyped
    """Whether an actor was left behind by a process that no longer runs."""
    role, _, process = actor.attributes.get("role_name", "").partition("-")
    return role == _ROLE and not Path(f"/proc/{process}").exists()


SENSOR = "sensor.lidar.ray_cast"
LOOKS = {
    "car": "vehicle.tesla.model3",
    "microcargo": "vehicle.volkswagen.t2",
    "minibus": "vehicle.mitsubishi.fusorosa",
    "box": "vehicle.carlamotors.carlacola",
}
"""Blueprints by mesh."""
_AWAY = np.array([0.0, 0, 1000, 0, 0, 0])
KINDS = ("vehicle", "roadside")


class CarlaSource:
    """Scans of CARLA's ray-cast LiDAR: one sensor for all agents of one kind of a process.

    Each scan is one tick of CARLA's, in which the sensor turns round once while everything stands
    still. The body that carries the sensor is away meanwhile.
    """

    def __init__(self, setup: Setup, lidar: LidarConfig, settings: dict[str, Any]) -> None:
        """Connects and spawns the sensor.

        Raises:
            ConfigError: the server cannot be used.
        """
        self._config = config = CarlaConfig.model_validate(settings)
        self._pattern = lidar.pattern
        self._looks = {
            t.name: config.blueprints.get(t.name, LOOKS[t.mesh]) for t in setup.vehicle_types
        }
        self._measured: queue.Queue[Any] = queue.Queue()
        self._casting = False
        self._server = CarlaServer(config, 1 / lidar.rotation_frequency)
        with self._server.turn():
            blueprint = self._server.blueprint(SENSOR)
            attributes = lidar.model_dump(include=ATTRIBUTES) | {
                "horizontal_fov": 360.0,
                "noise_seed": setup.scenario["seed"],
            }
            for name, value in attributes.items():
                blueprint.set_attribute(name, str(value))
            away = self._server.transform(_AWAY)
            self._sensor = self._server.world.spawn_actor(blueprint, away)
            self._sensor.listen(self._take)

    @staticmethod
    def check(scenario: dict[str, Any]) -> None:
        """Refuses a scenario that CARLA cannot serve.

        Raises:
            ConfigError: it is such a one, or CARLA's package is not installed.
        """
        load_carla()
        kinds = {kind: LidarConfig.model_validate(scenario["lidar"][kind]) for kind in KINDS}
        needs, amplitude_m = [], scenario["scene"]["terrain_amplitude_m"]
        if amplitude_m:  # bodies and roadside units stand on CARLA's ground
            needs.append(f"scene.terrain_amplitude_m 0 (got {amplitude_m:g})")
        if len({config.rotation_frequency for config in kinds.values()}) > 1:  # it has one step
            needs.append("the same rotation_frequency for lidar.vehicle and lidar.roadside")
        for kind, config in kinds.items():
            if config.pattern.elevations_deg:  # CARLA's rings lie at equal steps
                needs.append(f"lidar.{kind}.model full or sparse (got {config.model})")
            if config.columns % 2:  # CARLA's beams begin half a turn from the front
                needs.append(
                    f"an even number of rays a turn and laser (lidar.{kind}: {config.columns})"
                )
        if needs:
            raise ConfigError(f"lidar.source: carla needs {', and '.join(needs)}")

    def scan(self, agent: str, view: WorldView, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        """See `sensing.source.ScanSource.scan`; CARLA does not tell which bodies the points lie on.

        Raises:
            BusError: the server is lost.
        """
        server, offset_m = self._server, self._config.net_offset_m
        poses = {
            body: carla_pose(view.poses[n], offset_m) if n != own else _AWAY
            for n, body in enumerate(view.ids)
        }
        looks = {body: self._looks[kind] for body, kind in zip(view.ids, view.types, strict=True)}
        sensor_pose = carla_pose(map_SE3_sensor.as_pose(), offset_m)
        with server.turn():
            server.place(poses, looks)
            server.move({self._sensor.id: server.transform(sensor_pose)})
            self._casting = True
            points = self._measured_at(server.world.tick(self._config.timeout_s))
            self._casting = False
            server.hide()
        return Sensed(scan_of(points, self._pattern), np.zeros(0, np.int64))

    def close(self) -> None:
        """Destroys the sensor and the bodies; CARLA's world remains in synchronous mode."""
        with self._server.turn():
            self._sensor.stop()
            self._sensor.destroy()
            self._server.clear()

    def _take(self, measurement: Any) -> None:  # noqa: ANN401 - CARLA is untyped
        if self._casting:  # else it is another process's tick
            self._measured.put(measurement)

    def _measured_at(self, frame: int) -> Floats32:
        """Returns the points (N, 4) of one of CARLA's ticks."""
        while True:
            try:
                measurement = self._measured.get(timeout=self._config.timeout_s)
            except queue.Empty:
                raise BusError(f"CARLA's LiDAR sent no measurement of its frame {frame}") from None
            if measurement.frame == frame:
                return np.frombuffer(measurement.raw_data, np.float32).reshape(-1, 4)
