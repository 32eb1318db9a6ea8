"""Scans that CARLA's ray-cast LiDAR takes in CARLA's world, among the bodies of a tick."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.arrays import Floats32
from protocol.errors import BusError
from protocol.geometry import SE3
from protocol.messages import Tick, VehicleType
from sensing.carla.config import CarlaConfig
from sensing.carla.frames import carla_pose, scan_of
from sensing.carla.server import Server
from sensing.config import LidarConfig
from sensing.lidar import Sensed

SENSOR = "sensor.lidar.ray_cast"
LOOKS = {
    "car": "vehicle.tesla.model3",
    "microcargo": "vehicle.volkswagen.t2",
    "minibus": "vehicle.mitsubishi.fusorosa",
    "box": "vehicle.carlamotors.carlacola",
}
"""Blueprints by mesh."""
_AWAY = np.array([0.0, 0, 1000, 0, 0, 0])


class Carla:
    """One sensor for all agents of one kind of a process: it goes from agent to agent.

    Each scan is one tick of CARLA's, in which the sensor turns round once while everything stands
    still. The body that carries the sensor is away meanwhile.
    """

    def __init__(
        self, config: CarlaConfig, lidar: LidarConfig, types: Sequence[VehicleType], seed: int
    ) -> None:
        """Connects and puts the sensor up.

        Raises:
            ConfigError: the server cannot be used.
        """
        self._config = config
        self._pattern = lidar.pattern
        self._looks = {t.name: config.blueprints.get(t.name, LOOKS[t.mesh]) for t in types}
        self._measured: queue.Queue[Any] = queue.Queue()
        self._casting = False
        self._server = Server(config, 1 / lidar.rotation_frequency)
        with self._server.turn():
            blueprint = self._server.blueprint(SENSOR)
            # The attributes have the names of the scenario's keys.
            attributes = lidar.model_dump() | {"horizontal_fov": 360.0, "noise_seed": seed}
            for name, value in attributes.items():
                blueprint.set_attribute(name, str(value))
            away = self._server.transform(_AWAY)
            self._sensor = self._server.world.spawn_actor(blueprint, away)
            self._sensor.listen(self._take)

    def scan(self, agent: str, tick: Tick, map_SE3_sensor: SE3, own: int | None) -> Sensed:  # noqa: ARG002 - CARLA draws its noise
        """See `sensing.source.ScanSource.scan`; whose points these are, CARLA does not say.

        Raises:
            BusError: the server is lost.
        """
        server, offset_m = self._server, self._config.net_offset_m
        poses = {
            body: carla_pose(tick.poses[n], offset_m) if n != own else _AWAY
            for n, body in enumerate(tick.ids)
        }
        looks = {body: self._looks[kind] for body, kind in zip(tick.ids, tick.types, strict=True)}
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
        """Takes the sensor and the bodies away; CARLA's world goes on waiting for ticks."""
        with self._server.turn():
            self._sensor.stop()
            self._sensor.destroy()
            self._server.clear()

    def _take(self, measurement: Any) -> None:  # noqa: ANN401 - CARLA is untyped
        if self._casting:  # else it is another process's tick, and nobody would ever ask for it
            self._measured.put(measurement)

    def _measured_at(self, frame: int) -> Floats32:
        """Returns the points (N, 4) of one of CARLA's ticks."""
        while True:
            try:
                measurement = self._measured.get(timeout=self._config.timeout_s)
            except queue.Empty:
                raise BusError(f"CARLA's LiDAR said nothing of its frame {frame}") from None
            if measurement.frame == frame:
                return np.frombuffer(measurement.raw_data, np.float32).reshape(-1, 4)
