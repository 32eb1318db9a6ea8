"""Simulated clouds of many kinds of LiDAR, as their files hold them.

The clouds in files are not range images: azimuths that do not divide a turn, lasers that stand
beside the sensor's middle, rings of unequal spacing of which some fire half as often, several
sensors in a vehicle's frame, motion taken out, coordinates rounded, second returns. Each kind here
has the known properties of its files; points come in the order in which they were fired, but for
the HDL-64E's, which KITTI holds ring by ring. Spacings are of `sensing.sensor_models`, else of the
data sheets, to what matters here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from protocol.geometry import SE3
from protocol.scans import Floats, Floats32
from sensing.embree import Caster
from sensing.mesh import TriangleMesh
from sensing.noise import stream
from sensing.sensor_models import SENSOR_MODELS

NOISE_STD_M = 0.015  # of range, as data sheets state 1 to 3 cm
_LOSS = 0.1  # of the rays that hit something
_NEAREST_M = 0.5
_SPEED_MPS = 10.0
_TURN_S = 0.1
_HDL_32E = tuple(10.67 - n * 4 / 3 for n in range(32))
_OT128 = (
    *(14.9 - n * 0.85 for n in range(15)),
    *(2.05 - n * 0.125 for n in range(64)),  # the middle, which fires at every step
    *(-6.1 - n * 0.39 for n in range(49)),
)


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Rays in the order of the file: starts and unit directions (N, 3), and the file's rounding.

    `second_share` of the rays that hit have a second return behind the first.
    """

    starts_m: Floats
    directions: Floats
    round_m: float = 0.0
    second_share: float = 0.0
    half_precision: bool = False


def _spin(
    elevations_deg: npt.ArrayLike,
    columns: float,
    *,
    offsets_deg: npt.ArrayLike = 0.0,
    above_m: npt.ArrayLike = 0.0,
    beside_m: npt.ArrayLike = 0.0,
    moves: bool = False,
) -> tuple[Floats, Floats]:
    """Returns starts and directions (columns, rings, 3) of one turn, clockwise.

    Args:
        elevations_deg: of the rings.
        columns: in a full turn, not necessarily whole.
        offsets_deg: azimuth of each ring beside the column's.
        above_m: how far each laser stands above the middle.
        beside_m: how far it stands beside it, along the turn.
        moves: whether the sensor drives while it turns, and the files take that out.
    """
    turn = np.arange(int(columns)) / columns
    elevation = np.radians(np.asarray(elevations_deg, np.float64))[None, :]
    azimuth = -2 * np.pi * turn[:, None] + np.radians(offsets_deg)
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    flat, side = np.cos(elevation), np.broadcast_to(beside_m, azimuth.shape)
    directions = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    height = np.broadcast_to(above_m, azimuth.shape)
    starts = np.stack([-side * np.sin(azimuth), side * np.cos(azimuth), height], axis=-1)
    if moves:
        starts[..., 0] += _SPEED_MPS * _TURN_S * (turn[:, None] - 0.5)
    return starts, directions


def _in_order(starts: Floats, directions: Floats) -> Rays:
    return Rays(starts.reshape(-1, 3), directions.reshape(-1, 3))


def _even() -> Rays:
    return _in_order(*_spin(np.linspace(2, -24.9, 64), 1800))


def _hdl_64e() -> Rays:
    upper = np.arange(64) < 32
    at = np.where(upper, 0.21, 0.12) - 0.0014 * (np.arange(64) % 32)
    beside = np.where(np.arange(64) % 2, 0.026, -0.026)
    elevations = np.array(SENSOR_MODELS["hdl-64e"].elevations_deg)
    elevations = elevations + 0.05 * np.sin(7.0 * np.arange(64))  # each device's own
    offsets = np.where(np.arange(64) % 2, 4.0, -4.0) + np.sin(3.0 * np.arange(64))
    starts, directions = _spin(elevations, 2083.3, offsets_deg=offsets, above_m=at, beside_m=beside)
    starts, directions = starts.swapaxes(0, 1), directions.swapaxes(0, 1)  # ring by ring
    return Rays(starts.reshape(-1, 3), directions.reshape(-1, 3), round_m=0.001)


def _hdl_32e() -> Rays:
    return _in_order(*_spin(_HDL_32E, 1084.4, offsets_deg=0.332 / 32 * np.arange(32)))


def _vlp_32c(columns: float = 1807.2, *, moves: bool = False) -> tuple[Floats, Floats]:
    offsets = np.tile([1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4], 4)
    elevations = SENSOR_MODELS["vlp-32c"].elevations_deg
    return _spin(elevations, columns, offsets_deg=offsets, beside_m=0.042, moves=moves)


def _two_vlp_32c() -> Rays:
    over, under = np.array([1.35, 0.0, 0.15]), np.array([1.35, 0.0, -0.15])  # in the vehicle
    upright, turning = _vlp_32c(1807.2, moves=True), _vlp_32c(1801.9, moves=True)
    upside_down = np.array([1.0, -1.0, -1.0])
    firings = min(len(upright[0]), len(turning[0]))
    starts = (upright[0][:firings] + over, turning[0][:firings] * upside_down + under)
    directions = (upright[1][:firings], turning[1][:firings] * upside_down)
    every = (np.concatenate(both, axis=1).reshape(-1, 3) for both in (starts, directions))
    return Rays(next(every), next(every), half_precision=True)


def _ot128() -> Rays:
    starts, directions = _spin(_OT128, 3600.0, offsets_deg=np.tile([0.9, -0.9, 2.7, -2.7], 32))
    dense = (np.arange(128) >= 15) & (np.arange(128) < 79)
    fires = dense[None, :] | (np.arange(3600) % 2 == 0)[:, None]
    return Rays(starts[fires], directions[fires])


def _pandar64() -> Rays:
    offsets = np.where(np.arange(64) % 3 == 0, 3.257, np.where(np.arange(64) % 3 == 1, -1.042, 1.1))
    elevations = SENSOR_MODELS["pandar64"].elevations_deg
    return _in_order(*_spin(elevations, 1800.0, offsets_deg=offsets, beside_m=0.01))


def _os1_128() -> Rays:
    offsets = np.tile([4.23, 1.41, -1.41, -4.23], 32)
    elevations = SENSOR_MODELS["os1-128"].elevations_deg
    return _in_order(*_spin(elevations, 1024.0, offsets_deg=offsets, above_m=0.038))


def _rosette() -> Rays:
    """Six beams that two wedges turn in a flower that never closes, as the Livox Avia's."""
    time = np.arange(40_000)[:, None] / 240_000
    first, second = 2 * np.pi * 121.57 * time, -2 * np.pi * 77.06 * time
    beam = np.arange(6)[None, :] - 2.5
    across = 17.5 * (np.cos(first) + np.cos(second)) + 0.0 * beam
    up = 17.5 * (np.sin(first) + np.sin(second)) + 0.75 * beam
    directions = _directions(np.radians(across), np.radians(up))
    return Rays(np.zeros_like(directions), directions, round_m=0.001)


def _raster() -> Rays:
    """A mirror that swings to and fro over 120 deg, row by row, as solid-state sensors do."""
    swing = np.sin(np.linspace(-1.2, 1.2, 700)) / np.sin(1.2) * 60.0
    rows = np.linspace(12.5, -12.5, 126)
    across = np.where((np.arange(126) % 2)[:, None], -swing, swing)
    up = rows[:, None] + 0.1 * np.cos(np.radians(across))
    directions = _directions(np.radians(across), np.radians(up))
    return Rays(np.zeros_like(directions), directions)


def _directions(azimuth: Floats, elevation: Floats) -> Floats:
    flat = np.cos(elevation)
    every = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return every.reshape(-1, 3)


def _dual_returns() -> Rays:
    rays = _in_order(*_vlp_32c())
    return Rays(rays.starts_m, rays.directions, second_share=0.25)


def _three_sensors() -> Rays:
    starts, directions = [], []
    for pose in ([0, 0, 0, 0, 0, 0], [1, 0.9, -1, 0.5, 0.1, 1.2], [1, -0.9, -1, -0.5, 0.1, -1.2]):
        vehicle_SE3_sensor = SE3.from_pose(pose)
        at, along = _spin(np.linspace(15, -15, 32), 900.0)
        starts.append(vehicle_SE3_sensor.apply(at.reshape(-1, 3)))
        directions.append(along.reshape(-1, 3) @ vehicle_SE3_sensor.rotation.T)
    return Rays(np.concatenate(starts), np.concatenate(directions))


KINDS: dict[str, Callable[[], Rays]] = {
    "even rings, 64": _even,
    "HDL-64E, as KITTI": _hdl_64e,
    "HDL-32E, as nuScenes": _hdl_32e,
    "two VLP-32C, as Argoverse 2": _two_vlp_32c,
    "Hesai OT128": _ot128,
    "Pandar64": _pandar64,
    "OS1-128": _os1_128,
    "VLP-32C": lambda: _in_order(*_vlp_32c()),
    "VLP-32C, dual returns": _dual_returns,
    "three sensors of a vehicle": _three_sensors,
    "rosette, as Livox Avia": _rosette,
    "solid state, 120 x 25 deg": _raster,
}


def sensor_clouds(
    mesh: TriangleMesh, map_SE3_sensor: SE3, seed: int
) -> Iterator[tuple[str, Floats32]]:
    """Yields the name and the points (N, 3) of each kind, in the sensor's or vehicle's frame."""
    caster = Caster(mesh)
    for name, rays_of in KINDS.items():
        yield name, _cast(caster, map_SE3_sensor, rays_of(), stream(seed, "kind", name))


def _cast(caster: Caster, map_SE3_sensor: SE3, rays: Rays, rng: np.random.Generator) -> Floats32:
    starts = np.ascontiguousarray(map_SE3_sensor.apply(rays.starts_m).T, np.float32)
    directions = np.ascontiguousarray((rays.directions @ map_SE3_sensor.rotation.T).T, np.float32)
    range_m = np.full(len(rays.starts_m), 120.0, np.float32)
    caster.cast(starts, directions, range_m, np.empty(len(range_m), np.int32))
    hit = (range_m > _NEAREST_M) & (range_m < 120.0) & (rng.random(len(range_m)) >= _LOSS)
    returns = range_m.astype(np.float64)
    owner = np.flatnonzero(hit)
    if rays.second_share:
        twice = rng.random(len(owner)) < rays.second_share
        order = np.argsort(np.concatenate([2 * owner, 2 * owner[twice] + 1]))
        behind = returns[owner[twice]] + rng.exponential(2.0, int(twice.sum())) + 0.5
        returns = np.concatenate([returns[owner], behind])[order]
        owner = np.concatenate([owner, owner[twice]])[order]
    else:
        returns = returns[owner]
    returns = returns + rng.normal(0, NOISE_STD_M, len(returns))
    points = rays.starts_m[owner] + rays.directions[owner] * returns[:, None]
    if rays.round_m:
        points = np.round(points / rays.round_m) * rays.round_m
    if rays.half_precision:
        points = points.astype(np.float16).astype(np.float64)
    return points.astype(np.float32)
