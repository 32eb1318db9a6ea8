"""A CARLA server: its world waits for ticks, and bodies stand where they are put."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from perception.arrays import Floats
from protocol.errors import BusError, ConfigError
from sensing.carla.config import CarlaConfig

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
            f"(pip install 'cpnet-edge[carla]'): {error}"
        ) from None
    module: ModuleType = carla
    return module


class Server:
    """A connection of this process, with bodies of its own. Other processes have theirs.

    Those of all processes but the one whose `turn` it is are out of sight. So it does not matter
    who put up what, and each casts in a world that it has set up alone.
    """

    def __init__(self, config: CarlaConfig, tick_s: float) -> None:
        """Connects, loads the town and makes the world wait for ticks.

        Raises:
            ConfigError: nobody answers, or a server of another version or without that town.
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
                raise ConfigError(f"CARLA at {self._place} (carla.host, port): {error}") from None

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
        """Returns CARLA's own form of what `sensing.carla.frames.carla_pose` returned."""
        x, y, z, roll, pitch, yaw = map(float, pose)
        rotation = self.carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
        return self.carla.Transform(self.carla.Location(x=x, y=y, z=z), rotation)

    def place(self, poses: Mapping[str, Floats], looks: Mapping[str, str]) -> None:
        """Has exactly these bodies stand at these poses of CARLA's, by id; new ones by their looks.

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
        """Puts all bodies out of sight."""
        self.move(dict.fromkeys(self._bodies.values(), self._sky(0)))

    def clear(self) -> None:
        """Takes all bodies away."""
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
    """Whether a process that has died has left an actor behind."""
    role, _, process = actor.attributes.get("role_name", "").partition("-")
    return role == _ROLE and not Path(f"/proc/{process}").exists()
