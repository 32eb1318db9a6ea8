"""A small road and what a LiDAR would see of cars on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from protocol.geometry import SE3
from protocol.roadmap import Lane, Link, PlanPhase, RoadMap, Signal

Floats32 = npt.NDArray[np.float32]
SENSOR_HEIGHT_M = 3.0


def _lane(name: str, ends: list[tuple[float, float, float]], *after: str) -> Lane:
    points = np.array(ends)
    return Lane(
        id=name,
        edge=name.rpartition("_")[0],
        width_m=3.5,
        speed_mps=13.9,
        length_m=float(np.linalg.norm(points[-1] - points[0])),
        centreline=ends,
        successors=list(after),
        internal=name.startswith(":"),
    )


def make_road(climb: float = 0.0) -> RoadMap:
    """Two lanes from west to east through a junction at the origin, and one from the south.

    `far_0` opens into both lanes that end at the stop bar at x = -10; the road climbs by this
    much a metre from west to east.
    """

    def at(x: float, y: float) -> tuple[float, float, float]:
        return (x, y, climb * x)

    lanes = [
        _lane("far_0", [at(-310, 0), at(-160, 0)], "in_0", "in_1"),
        _lane("in_0", [at(-160, -1.75), at(-10, -1.75)], ":j_0"),
        _lane("in_1", [at(-160, 1.75), at(-10, 1.75)], ":j_1"),
        _lane(":j_0", [at(-10, -1.75), at(10, -1.75)], "out_0"),
        _lane(":j_1", [at(-10, 1.75), at(10, 1.75)], "out_1"),
        _lane("out_0", [at(10, -1.75), at(160, -1.75)], "gone_0"),
        _lane("out_1", [at(10, 1.75), at(160, 1.75)]),
        _lane("gone_0", [at(160, -1.75), at(200, -1.75)]),
        _lane("side_0", [at(1.75, -120), at(1.75, -10)], ":j_2"),
        _lane(":j_2", [at(1.75, -10), at(4, -4), at(10, -1.75)], "out_0"),
    ]
    links = [
        Link(index=0, from_lane="in_0", to_lane="out_0"),
        Link(index=1, from_lane="in_1", to_lane="out_1"),
        Link(index=2, from_lane="side_0", to_lane="out_0"),
    ]
    plan = [
        PlanPhase(duration_s=30, state="GGr"),
        PlanPhase(duration_s=4, state="yyr"),
        PlanPhase(duration_s=20, state="rrG"),
        PlanPhase(duration_s=4, state="rry"),
    ]
    return RoadMap(
        name="test",
        centre=(0.0, 0.0, 0.0),
        lanes=lanes,
        signal=Signal(tls="j", links=links, conflicts=[(0, 2)], plan=plan),
        junction=[(-10, -10), (10, -10), (10, 5), (-10, 5)],
    )


@pytest.fixture(scope="session")
def road_map() -> RoadMap:
    return make_road()


@pytest.fixture(scope="session")
def climbing_road() -> RoadMap:
    return make_road(climb=0.035)


def car_shell(
    pose: npt.ArrayLike, sensor: tuple[float, float], rng: np.random.Generator, points: int = 300
) -> Floats32:
    """Returns points (N, 3), map frame, on the roof and on the sides that face the sensor."""
    length_m, width_m, height_m = 4.5, 1.8, 1.5
    map_se3_car = SE3.from_pose(pose)
    x, y, _ = map_se3_car.inverse().apply(np.array([[*sensor, SENSOR_HEIGHT_M]]))[0]
    local = rng.uniform(-0.5, 0.5, (points, 3)) * [length_m, width_m, height_m]
    local[:, 2] += height_m / 2
    face = rng.integers(0, 3, points)
    local[face == 0, 2] = height_m
    local[face == 1, 0] = np.sign(x) * length_m / 2
    local[face == 2, 1] = np.sign(y) * width_m / 2
    if abs(x) < length_m / 2:  # the sensor stands abreast and sees neither end
        local = local[face != 1]
    if abs(y) < width_m / 2:
        local = local[face[: len(local)] != 2]
    return map_se3_car.apply(local).astype(np.float32)


def ground_points(rng: np.random.Generator, climb: float = 0.0, count: int = 40_000) -> Floats32:
    """Returns points (N, 3) on and beside the road, denser near the junction, with undulation."""
    x = rng.normal(0, 70, count).clip(-300, 200)
    y = rng.uniform(-15, 15, count)
    z = climb * x + 0.08 * np.sin(x / 9) * np.cos(y / 7) + rng.normal(0, 0.02, count)
    return np.column_stack([x, y, z]).astype(np.float32)


@pytest.fixture(scope="session")
def shell() -> Callable[..., Floats32]:
    return car_shell


@pytest.fixture(scope="session")
def ground() -> Callable[..., Floats32]:
    return ground_points
