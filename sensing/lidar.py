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
from sensing.beam_divergence import BeamWidths, mix_at_edges
from sensing.candidates import gather, keep_nearest, place, turn, windows
from sensing.config import LidarConfig
from sensing.embree import Caster
from sensing.mesh import VehicleShapes
from sensing.pose import driven
from sensing.reflectivity import (
    MEAN_PAINT,
    MIN_RANGE_M,
    apply_power,
    keep_nearest_lit,
    of_vehicle,
    static_strength,
    without_glass,
)
from sensing.scene import Scene
from sensing.weather import add_backscatter, attenuation_per_m, backscatter, drop_weak


def returns(
    view: RayHits, config: LidarConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32]:
    """Computes the returns: range, 0 for none, and intensity, both (channels, columns).

    Where surfaces differ, see `sensing.reflectivity`. Else after CARLA 0.9's `ARayCastLidar`
    (`RayCastLidar.cpp`): intensity is exp(-attenuation * d). `PreprocessRays` loses a ray with the
    general rate; `PostprocessDetection` moves the point along its ray by normal noise, then keeps
    one of intensity I above the limit always, any other with probability
    (1 - zero) + I * zero / limit. Here both losses are decided by one draw, with the product of the
    probabilities. Numbers are drawn for every ray, so that a ray's noise does not depend on what
    other rays hit.

    Args:
        view: what the rays hit.
        config: the sensor's parameters.
        rng: two draws per ray.
    """
    distance_m = view.distance_m
    draw = rng.random(distance_m.shape, np.float32)
    noise = rng.standard_normal(distance_m.shape, np.float32)
    if config.range_at_10_percent_m is not None:
        return _returns_by_power(view, config, draw, noise)
    range_m, intensity = np.empty_like(distance_m), np.empty_like(distance_m)
    keep = 1.0 - config.dropoff_general_rate
    np.multiply(distance_m, np.float32(-config.atmosphere_attenuation_rate), out=intensity)
    np.exp(intensity, out=intensity)
    rates = np.array(
        [
            np.float32(config.range),
            keep,
            config.dropoff_intensity_limit,
            config.dropoff_zero_intensity,
            config.noise_stddev,
        ]
    )
    arrays = (distance_m, draw, noise, range_m, intensity)
    _apply_losses(*(a.reshape(-1) for a in arrays), rates)
    return range_m, intensity


def _returns_by_power(
    view: RayHits, config: LidarConfig, draw: Floats32, noise: Floats32
) -> tuple[Floats32, Floats32]:
    distance_m, strength = view.distance_m, view.strength
    if config.beam_divergence_mrad:
        widths = BeamWidths.of(config.pattern, config.beam_divergence_mrad)
        mixed_m, mixed = np.empty_like(distance_m), np.empty_like(strength)
        mix_at_edges(distance_m, strength, draw, widths.along, widths.across, mixed_m, mixed)
        distance_m, strength = mixed_m, mixed
    range_m, intensity = np.empty_like(distance_m), np.empty_like(distance_m)
    keep, dark_m = 1.0 - config.dropoff_general_rate, config.range_at_10_percent_m
    rates = [config.range, keep, dark_m, config.noise_stddev, attenuation_per_m(config)]
    flat = (distance_m, strength, draw, noise, range_m, intensity)
    apply_power(*(a.reshape(-1) for a in flat), np.array(rates, np.float64))
    if (air := backscatter(config)) is not None:
        arrays = (distance_m, draw, noise, range_m, intensity)
        chance, fog = np.float32(air.chance), np.float32(air.fog)
        add_backscatter(*(a.reshape(-1) for a in arrays), air.table, chance, fog)
    if config.noise_filter:
        drop_weak(range_m, intensity)
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

    def __init__(self, scene: Scene, pattern: ScanPattern, *, lit: bool) -> None:
        self._shape = pattern.channels, pattern.columns
        self._caster = Caster(scene.mesh)
        self._surfaces = scene.surfaces() if lit else None
        self._directions = np.ascontiguousarray(pattern.directions.reshape(-1, 3).T)
        self._turned = np.empty_like(self._directions)
        self._faces = np.empty(self._directions.shape[1], np.int32)

    def cast(self, map_SE3_sensor: SE3, range_m: float) -> StaticView:
        """Returns what the rays hit; nothing lies at `range_m` or farther."""
        distance_m = np.full(self._shape, range_m, np.float32)
        strength = np.zeros(self._shape if self._surfaces else (0, 0), np.float32)
        start = map_SE3_sensor.translation.astype(np.float32).reshape(3, 1)
        turn(self._directions, map_SE3_sensor.rotation.astype(np.float32), self._turned)
        self._caster.cast(start, self._turned, distance_m.reshape(-1), self._faces)
        if (surfaces := self._surfaces) is not None:
            static_strength(
                distance_m.reshape(-1),
                self._faces,
                self._turned,
                surfaces.power,
                np.float32(range_m),
                strength.reshape(-1),
            )
        return StaticView(distance_m, strength)


@dataclass(frozen=True, slots=True, eq=False)
class StaticView:
    """Clean distances, and reflectivity times cosine, both (channels, columns).

    The latter is empty where all surfaces are alike.
    """

    distance_m: Floats32
    strength: Floats32


_ON_BODY_M = 0.5  # farther off a return is another object's: a drop's, or that of what is behind
_KEPT_VIEWS = 32  # of sensors that stand still: 0.5 MB each


_Buffers = tuple[Floats32, Floats32, Floats32, Ints32, Ints32, Ints32]


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """Clean distances and what is hit, both (channels, columns).

    The range's end where nothing is; the index of a body, -1 where none is. `strength` is as of
    `StaticView`.
    """

    distance_m: Floats32
    body: Ints32
    strength: Floats32

    def points_on(self, range_m: Floats32, bodies: int) -> Ints:
        """Counts by body (bodies,) the beams that end on it and return."""
        on_body = (self.body >= 0) & (range_m > 0)
        on_body &= np.abs(range_m - self.distance_m) < _ON_BODY_M
        return np.bincount(self.body[on_body], minlength=bodies)


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """A scan, and how many of its points lie on each body (N,); empty where that is unknown."""

    scan: RangeScan
    points_on: Ints


class _Rays:
    """Buffers of rays: origins, directions, limits, beams, bodies, faces; used again each scan."""

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
            np.empty(count, np.int32),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _BodiesInView:
    """Bodies (N,) as a sensor has them before it: see `sensing.candidates`.

    Attributes:
        mesh: index of each body's unit mesh (N,).
        bounds: lowest and highest corner of that mesh (N, 6).
        placed: where each is about the sensor (N, 12, 3).
        windows: the rings and columns whose beams may hit each (N, 4).
    """

    mesh: Ints
    bounds: Floats
    placed: Floats
    windows: Ints

    @property
    def rays(self) -> Ints:
        """How many beams may hit each (N,)."""
        return np.asarray((self.windows[:, 1] - self.windows[:, 0]) * self.windows[:, 3])


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
        lit = config.range_at_10_percent_m is not None
        self._static = StaticWorld(scene, self._pattern, lit=lit)
        meshes = [without_glass(mesh) for mesh in shapes.meshes] if lit else shapes.meshes
        self._casters = [Caster(mesh) for mesh in meshes]
        self._surfaces = [of_vehicle(mesh) for mesh in meshes] if lit else None
        self._bounds = np.array(
            [[*m.vertices.min(axis=0), *m.vertices.max(axis=0)] for m in shapes.meshes], np.float64
        ).reshape(-1, 6)
        self._rays = _Rays()
        self._views: OrderedDict[bytes, StaticView] = OrderedDict()

    def scan(
        self,
        map_SE3_sensor: SE3,
        poses: Floats,
        types: Sequence[str],
        own: int | None,
        rng: np.random.Generator,
        paint: Floats32 | None = None,
        speeds_mps: Floats32 | None = None,
    ) -> Sensed:
        """Returns one revolution.

        With a rolling shutter, each body is where it is when the beam passes its middle. An agent
        corrects a scan for the sensor's own motion: with odometry that is 0.1 m/s off, half a
        revolution leaves 5 mm.

        Args:
            map_SE3_sensor: where the sensor truly is.
            poses: all bodies' (N, 6), footprint's centre on the ground, in the map frame.
            types: their types (N,).
            own: index of the body that carries the sensor and is not seen; None at the roadside.
            rng: for loss and noise; keyed by agent and frame.
            paint: reflectivity of the bodies' paint (N,); a mean one without.
            speeds_mps: of the bodies (N,), along their heading; they stand without.

        Raises:
            MessageError: a type that the setup does not contain.
        """
        if self._config.rolling_shutter and speeds_mps is not None:
            poses = driven(poses, speeds_mps * self._after_s(map_SE3_sensor, poses))
        near = self._within_range(map_SE3_sensor, poses)
        others = near if own is None else near[near != own]
        paints = np.full(len(poses), MEAN_PAINT, np.float32) if paint is None else paint
        view = self.view(
            map_SE3_sensor, poses[others], [types[n] for n in others], None, paints[others]
        )
        range_m, intensity = returns(view, self._config, rng)
        points_on = np.zeros(len(poses), np.int64)
        points_on[others] = view.points_on(range_m, len(others))
        return Sensed(RangeScan(self._pattern, range_m, intensity), points_on)

    def _after_s(self, map_SE3_sensor: SE3, poses: Floats) -> Floats:
        """Returns how long after the middle of the revolution the beam passes each body (N,).

        The sensor turns clockwise, as the HDL-64E does, and is at azimuth 0 at that time.
        """
        places = map_SE3_sensor.inverse().apply(poses[:, :3])
        turns = np.arctan2(places[:, 1], places[:, 0]) / (2 * np.pi)
        result: Floats = -turns / self._config.rotation_frequency
        return result

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
        paint: Floats32 | None = None,
    ) -> RayHits:
        """Returns what the rays hit, before loss and noise; see `scan`."""
        static = self._static_view(map_SE3_sensor)
        distance_m = static.distance_m.copy()
        nobody = np.full(distance_m.shape, -1, np.int32)
        view = RayHits(distance_m, nobody, static.strength.copy())
        if len(poses):
            paint = np.full(len(poses), MEAN_PAINT, np.float32) if paint is None else paint
            self._add_bodies(view, map_SE3_sensor, poses, types, own, paint)
        return view

    def _static_view(self, map_SE3_sensor: SE3) -> StaticView:
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
        paint: Floats32,
    ) -> None:
        bodies = self._bodies_in_view(map_SE3_sensor, poses, types, own)
        for mesh in range(len(self._casters)):
            members = np.flatnonzero((bodies.mesh == mesh) & (bodies.rays > 0))
            if len(members):
                self._add_bodies_of_mesh(view, mesh, bodies, members, paint)

    def _bodies_in_view(
        self, map_SE3_sensor: SE3, poses: Floats, types: Sequence[str], own: int | None
    ) -> _BodiesInView:
        """Places the bodies about the sensor and finds the beams that may hit them."""
        bodies = self._shapes.bodies(types)
        bounds = self._bounds[bodies.mesh]
        placed = np.empty((len(poses), 12, 3))
        rotation, translation = map_SE3_sensor.rotation.copy(), map_SE3_sensor.translation.copy()
        place(np.array(poses, np.float64), bodies.size_m, bounds, rotation, translation, placed)
        parts = np.empty((len(poses), 4), np.int64)
        pattern, range_m = self._pattern, float(self._config.range)
        windows(placed, pattern.elevations_rad, pattern.columns, range_m, parts)
        if own is not None:
            parts[own] = 0
        return _BodiesInView(bodies.mesh, bounds, placed, parts)

    def _add_bodies_of_mesh(
        self, view: RayHits, mesh: int, bodies: _BodiesInView, members: Ints, paint: Floats32
    ) -> None:
        """Casts the rays that may hit bodies of one unit mesh, and keeps what is nearest."""
        buffers = self._rays.reserved(int(bodies.rays[members].sum()))
        origins, directions, limits, beams, owners, faces = buffers
        count = gather(
            self._pattern.directions,
            view.distance_m,
            bodies.placed,
            bodies.bounds,
            bodies.windows,
            members,
            *buffers[:5],
        )
        self._casters[mesh].cast(origins, directions, limits[:count], faces)
        flat = view.distance_m.reshape(-1), view.body.reshape(-1)
        found = beams[:count], owners[:count], limits[:count]
        if self._surfaces is None:
            keep_nearest(*flat, *found)
            return
        surfaces = self._surfaces[mesh]
        keep_nearest_lit(
            *flat,
            view.strength.reshape(-1),
            *found,
            faces,
            directions,
            bodies.placed,
            surfaces.normals,
            surfaces.reflectivity,
            paint,
        )
