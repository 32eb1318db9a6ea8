"""LiDAR model: casts a pattern into scene and vehicles, adds CARLA's intensity, loss and noise."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.arrays import Floats32, Ints, Ints32
from protocol.geometry import SE3, Floats
from protocol.limits import MAX_LENGTH_M
from protocol.scans import RangeScan, ScanPattern
from sensing.candidates import gather, keep_nearest, place, turn, windows
from sensing.config import LidarConfig
from sensing.embree import Caster
from sensing.mesh import VehicleShapes
from sensing.scene import Scene

MIN_RANGE_M = 0.5


def returns(
    distance_m: Floats32, config: LidarConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32]:
    """Returns range, 0 for none, and intensity, each of the distance's shape.

    After CARLA 0.9's `ARayCastLidar` (`RayCastLidar.cpp`): intensity is exp(-attenuation * d).
    `PreprocessRays` loses a ray with the general rate; `PostprocessDetection` moves the point
    along its ray by normal noise, then keeps one of intensity I above the limit always, any other
    with probability (1 - zero) + I * zero / limit. Here both losses are decided by one draw, with
    the product of the probabilities. Numbers are drawn for every ray, so that a ray's noise does
    not depend on what other rays hit.

    Args:
        distance_m: to the first surface along each ray; the range's end or more for none.
        config: the sensor's parameters.
        rng: two draws per ray.
    """
    draw = rng.random(distance_m.shape, np.float32)
    noise = rng.standard_normal(distance_m.shape, np.float32)
    intensity = distance_m * np.float32(-config.atmosphere_attenuation_rate)
    np.exp(intensity, out=intensity)
    range_m = np.empty_like(distance_m)
    rates = np.array(
        [
            np.float32(config.range),
            1.0 - config.dropoff_general_rate,
            config.dropoff_intensity_limit,
            config.dropoff_zero_intensity,
            config.noise_stddev,
        ]
    )
    flat = [a.reshape(-1) for a in (distance_m, draw, noise, range_m, intensity)]
    _apply_losses(*flat, rates)
    return range_m, intensity


def return_probability(distance_m: Floats, config: LidarConfig) -> Floats:
    """Returns the probability that a ray which hits something at this distance returns."""
    intensity = np.exp(-config.atmosphere_attenuation_rate * distance_m)
    zero, limit = config.dropoff_zero_intensity, config.dropoff_intensity_limit
    weak = np.where(intensity <= limit, 1.0 - zero + intensity * zero / limit, 1.0)
    result: Floats = (1.0 - config.dropoff_general_rate) * weak
    return result


@njit(
    "void(float32[::1], float32[::1], float32[::1], float32[::1], float32[::1], float64[::1])",
    cache=True,
)
def _apply_losses(
    distance_m: Floats32,
    draw: Floats32,
    noise: Floats32,
    range_m: Floats32,
    intensity: Floats32,
    rates: npt.NDArray[np.float64],
) -> None:
    farthest, keep, limit, zero, stddev = rates
    for n in range(len(distance_m)):
        value = intensity[n]
        chance = keep
        if value <= limit:
            chance *= 1.0 - zero + value * zero / limit
        if MIN_RANGE_M <= distance_m[n] < farthest and draw[n] < chance:
            range_m[n] = max(distance_m[n] + noise[n] * stddev, MIN_RANGE_M)
        else:
            range_m[n] = 0.0
            intensity[n] = 0.0


class StaticWorld:
    """Casts whole patterns into the scene."""

    def __init__(self, scene: Scene, pattern: ScanPattern) -> None:
        self._shape = pattern.channels, pattern.columns
        self._caster = Caster(scene.mesh)
        self._directions = np.ascontiguousarray(pattern.directions.reshape(-1, 3).T)
        self._turned = np.empty_like(self._directions)

    def cast(self, map_SE3_sensor: SE3, range_m: float) -> Floats32:
        """Returns clean distances (channels, columns); `range_m` where nothing is."""
        distance_m = np.full(self._shape, range_m, np.float32)
        start = map_SE3_sensor.translation.astype(np.float32).reshape(3, 1)
        turn(self._directions, map_SE3_sensor.rotation.astype(np.float32), self._turned)
        self._caster.cast(start, self._turned, distance_m.reshape(-1))
        return distance_m


_KEPT_VIEWS = 32  # of sensors that stand still: 0.5 MB each


_Buffers = tuple[Floats32, Floats32, Floats32, Ints32, Ints32]


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """Clean distances and what is hit, both (channels, columns).

    The range's end where nothing is; the index of a body, -1 where none is.
    """

    distance_m: Floats32
    body: Ints32

    def points_on(self, range_m: Floats32, bodies: int) -> Ints:
        """Counts by body (bodies,) the beams that end on it and return."""
        return np.bincount(self.body[(self.body >= 0) & (range_m > 0)], minlength=bodies)


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """A scan, and how many of its points lie on each body (N,); empty where that is unknown."""

    scan: RangeScan
    points_on: Ints


class _Rays:
    """Buffers of rays: origins, directions, limits, beams, bodies; used again from scan to scan."""

    def __init__(self) -> None:
        self._buffers = self._made(0)

    def reserved(self, count: int) -> _Buffers:
        """Returns buffers for at least this many rays."""
        if count > len(self._buffers[2]):
            self._buffers = self._made(count)
        return self._buffers

    @staticmethod
    def _made(count: int) -> _Buffers:
        return (
            np.empty((3, count), np.float32),
            np.empty((3, count), np.float32),
            np.empty(count, np.float32),
            np.empty(count, np.int32),
            np.empty(count, np.int32),
        )


class Lidar:
    """Casts scans; one object serves any number of sensors of one kind.

    The static scene and each unit mesh are built into Embree once. A frame's bodies cost only the
    rays that pass through their boxes, and no search tree is built again. The view of the static
    scene is kept for sensors that have not moved since.
    """

    def __init__(self, config: LidarConfig, scene: Scene, shapes: VehicleShapes) -> None:
        self._config = config
        self._pattern = config.pattern
        self._shapes = shapes
        self._static = StaticWorld(scene, self._pattern)
        self._casters = [Caster(mesh) for mesh in shapes.meshes]
        self._bounds = np.array(
            [[*m.vertices.min(axis=0), *m.vertices.max(axis=0)] for m in shapes.meshes], np.float64
        ).reshape(-1, 6)
        self._rays = _Rays()
        self._views: OrderedDict[bytes, Floats32] = OrderedDict()

    def scan(
        self,
        map_SE3_sensor: SE3,
        poses: Floats,
        types: Sequence[str],
        own: int | None,
        rng: np.random.Generator,
    ) -> Sensed:
        """Returns one revolution, cast at one instant.

        Args:
            map_SE3_sensor: where the sensor truly is.
            poses: all bodies' (N, 6), footprint's centre on the ground, in the map frame.
            types: their types (N,).
            own: index of the body that carries the sensor and is not seen; None at the roadside.
            rng: for loss and noise; keyed by agent and frame.

        Raises:
            MessageError: a type that the set-up did not announce.
        """
        near = self._within_range(map_SE3_sensor, poses)
        others = near if own is None else near[near != own]
        view = self.view(map_SE3_sensor, poses[others], [types[n] for n in others], None)
        range_m, intensity = returns(view.distance_m, self._config, rng)
        points_on = np.zeros(len(poses), np.int64)
        points_on[others] = view.points_on(range_m, len(others))
        return Sensed(RangeScan(self._pattern, range_m, intensity), points_on)

    def _within_range(self, map_SE3_sensor: SE3, poses: Floats) -> Ints:
        """Returns the indices of the bodies of which a ray could reach a part."""
        away_m = np.hypot(*(poses[:, :2] - map_SE3_sensor.translation[:2]).T)
        return np.flatnonzero(away_m <= self._config.range + MAX_LENGTH_M)

    def view(
        self,
        map_SE3_sensor: SE3,
        poses: Floats,
        types: Sequence[str],
        own: int | None,
    ) -> RayHits:
        """Returns what the rays hit, before loss and noise; see `scan`."""
        distance_m = self._static_view(map_SE3_sensor).copy()
        view = RayHits(distance_m, np.full(distance_m.shape, -1, np.int32))
        if len(poses):
            self._add_bodies(view, map_SE3_sensor, poses, types, own)
        return view

    def _static_view(self, map_SE3_sensor: SE3) -> Floats32:
        key = map_SE3_sensor.translation.tobytes() + map_SE3_sensor.rotation.tobytes()
        view = self._views.get(key)
        if view is None:
            view = self._static.cast(map_SE3_sensor, self._config.range)
            self._views[key] = view
            if len(self._views) > _KEPT_VIEWS:
                self._views.popitem(last=False)
        self._views.move_to_end(key)
        return view

    def _add_bodies(
        self,
        view: RayHits,
        map_SE3_sensor: SE3,
        poses: Floats,
        types: Sequence[str],
        own: int | None,
    ) -> None:
        bodies = self._shapes.bodies(types)
        bounds = self._bounds[bodies.mesh]
        placed = np.empty((len(poses), 12, 3))
        rotation, translation = map_SE3_sensor.rotation.copy(), map_SE3_sensor.translation.copy()
        place(np.array(poses, np.float64), bodies.size_m, bounds, rotation, translation, placed)
        parts = np.empty((len(poses), 4), np.int64)
        pattern = self._pattern
        fov_rad = np.radians([pattern.upper_fov_deg, pattern.lower_fov_deg])
        windows(
            placed, fov_rad, pattern.channels, pattern.columns, float(self._config.range), parts
        )
        if own is not None:
            parts[own] = 0
        sizes = (parts[:, 1] - parts[:, 0]) * parts[:, 3]
        for index, caster in enumerate(self._casters):
            members = np.flatnonzero((bodies.mesh == index) & (sizes > 0))
            if len(members):
                buffers = self._rays.reserved(int(sizes[members].sum()))
                count = gather(
                    pattern.directions, view.distance_m, placed, bounds, parts, members, *buffers
                )
                origins, directions, limits, beams, owners = buffers
                caster.cast(origins, directions, limits[:count])
                flat = view.distance_m.reshape(-1), view.body.reshape(-1)
                keep_nearest(*flat, beams[:count], owners[:count], limits[:count])
