"""Fake of the used part of CARLA's Python package, after its documentation, without a server.

Angles are in degrees, and `Transform.get_matrix` is CARLA's own, left-handed one. A LiDAR sees of
each actor one point, 1 m above its place; one that a scan's pattern has no beam for is lost.
"""

from __future__ import annotations

import itertools
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

VERSION = "0.9.15"


@dataclass
class Location:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Rotation:
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


@dataclass
class Transform:
    location: Location
    rotation: Rotation

    def get_matrix(self) -> list[list[float]]:
        angles = np.radians([self.rotation.yaw, self.rotation.roll, self.rotation.pitch])
        cy, cr, cp = np.cos(angles)
        sy, sr, sp = np.sin(angles)
        at = self.location
        return [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, at.x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, at.y],
            [sp, -cp * sr, cp * cr, at.z],
            [0.0, 0.0, 0.0, 1.0],
        ]


@dataclass
class Blueprint:
    id: str
    attributes: dict[str, str] = field(default_factory=dict)

    def set_attribute(self, name: str, value: str) -> None:
        assert isinstance(value, str)
        self.attributes[name] = value


@dataclass
class Actor:
    world: World
    id: int
    type_id: str
    attributes: dict[str, str]
    transform: Transform
    has_physics: bool = True
    callback: Callable[[Any], None] | None = None

    def listen(self, callback: Callable[[Any], None]) -> None:
        self.callback = callback

    def stop(self) -> None:
        self.callback = None

    def destroy(self) -> bool:
        return self.world.actors.pop(self.id, None) is not None

    def sees(self) -> np.ndarray:
        inverse = np.linalg.inv(np.array(self.transform.get_matrix()))
        reach_m = float(self.attributes["range"])
        places = [
            [a.transform.location.x, a.transform.location.y, a.transform.location.z + 1, 1]
            for a in self.world.actors.values()
            if a.type_id.startswith("vehicle.")
        ]
        local = (np.array(places).reshape(-1, 4) @ inverse.T)[:, :3]
        local = local[np.linalg.norm(local, axis=1) < reach_m]
        return np.column_stack([local, np.full(len(local), 0.5)]).astype(np.float32)


@dataclass
class Settings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float | None = None


class Library:
    def find(self, name: str) -> Blueprint:
        if not name.startswith(("vehicle.", "sensor.lidar.ray_cast")) or "nothing" in name:
            raise IndexError(f"blueprint '{name}' not found")
        return Blueprint(name)


class World:
    def __init__(self, town: str) -> None:
        self.town = town
        self.actors: dict[int, Actor] = {}
        self.settings = Settings()
        self.frame = 100
        self._numbers = itertools.count(1)

    def get_map(self) -> Any:
        return types.SimpleNamespace(name=f"Carla/Maps/{self.town}")

    def get_settings(self) -> Settings:
        return Settings(**vars(self.settings))

    def apply_settings(self, settings: Settings) -> int:
        self.settings = settings
        return self.frame

    def get_blueprint_library(self) -> Library:
        return Library()

    def get_actors(self) -> list[Actor]:
        return list(self.actors.values())

    def spawn_actor(self, blueprint: Blueprint, transform: Transform) -> Actor:
        if blueprint.id.startswith("vehicle.") and any(
            actor.transform.location == transform.location for actor in self.actors.values()
        ):
            raise RuntimeError("Spawn failed because of collision at spawn position")
        number = next(self._numbers)
        actor = Actor(self, number, blueprint.id, dict(blueprint.attributes), transform)
        self.actors[number] = actor
        return actor

    def tick(self, seconds: float = 10.0) -> int:
        assert self.settings.synchronous_mode
        self.frame += 1
        for sensor in [actor for actor in self.actors.values() if actor.callback]:
            data = sensor.sees().tobytes()
            sensor.callback(types.SimpleNamespace(frame=self.frame, raw_data=data))
        return self.frame


class Response:
    def __init__(self, actor_id: int = 0, error: str = "") -> None:
        self.actor_id, self.error = actor_id, error


class SpawnActor:
    def __init__(self, blueprint: Blueprint, transform: Transform) -> None:
        self.blueprint, self.transform, self.others = blueprint, transform, []

    def then(self, command: Any) -> SpawnActor:
        self.others.append(command)
        return self

    def do(self, world: World, _: int) -> Response:
        try:
            actor = world.spawn_actor(self.blueprint, self.transform)
        except RuntimeError as error:
            return Response(error=str(error))
        for command in self.others:
            command.do(world, actor.id)
        return Response(actor.id)


class OfActor:
    """A command that is given to an actor, by its number."""

    def __init__(self, actor_id: int, value: Any = None) -> None:
        self.actor_id, self.value = actor_id, value

    def do(self, world: World, spawned: int) -> Response:
        number = spawned if self.actor_id == FUTURE_ACTOR else self.actor_id
        if number not in world.actors:
            return Response(error=f"unable to find actor {number}")
        self.apply(world.actors[number])
        return Response(number)

    def apply(self, actor: Actor) -> None:
        raise NotImplementedError


class ApplyTransform(OfActor):
    def apply(self, actor: Actor) -> None:
        actor.transform = self.value


class SetSimulatePhysics(OfActor):
    def apply(self, actor: Actor) -> None:
        actor.has_physics = self.value


class DestroyActor(OfActor):
    def apply(self, actor: Actor) -> None:
        actor.destroy()


FUTURE_ACTOR = 0


class Package(types.ModuleType):
    """The package, and the one server that its clients reach at 127.0.0.1:2000."""

    def __init__(self, town: str = "Town04", version: str = VERSION) -> None:
        super().__init__("carla")
        self.world, self.version, self.loaded = World(town), version, []
        self.Location, self.Rotation, self.Transform = Location, Rotation, Transform
        self.command = types.SimpleNamespace(
            SpawnActor=SpawnActor,
            ApplyTransform=ApplyTransform,
            SetSimulatePhysics=SetSimulatePhysics,
            DestroyActor=DestroyActor,
            FutureActor=FUTURE_ACTOR,
        )

    def Client(self, host: str, port: int) -> FakeClient:
        return FakeClient(self, (host, port))

    @property
    def vehicles(self) -> list[Actor]:
        return [a for a in self.world.actors.values() if a.type_id.startswith("vehicle.")]


class FakeClient:
    def __init__(self, package: Package, place: tuple[str, int]) -> None:
        self._package, self._place = package, place

    def set_timeout(self, seconds: float) -> None:
        assert seconds > 0

    def get_client_version(self) -> str:
        return VERSION

    def get_server_version(self) -> str:
        if self._place != ("127.0.0.1", 2000):
            raise RuntimeError("time-out of 1000ms while waiting for the simulator")
        return self._package.version

    def get_world(self) -> World:
        return self._package.world

    def load_world(self, town: str) -> World:
        if town == "Nowhere":
            raise RuntimeError("map not found")
        self._package.loaded.append(town)
        self._package.world = World(town)
        return self._package.world

    def apply_batch_sync(self, commands: list[Any], do_tick: bool) -> list[Response]:
        assert do_tick is False
        return [command.do(self._package.world, -1) for command in commands]
