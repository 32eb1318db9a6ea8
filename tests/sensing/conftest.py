"""A small street, and boxes for vehicles."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.messages import VehicleType
from protocol.roadmap import Lane, Link, RoadMap, Signal
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh, VehicleShapes, extrude, merge
from sensing.scene import Scene, build_scene

SEED = 7


def lane(name: str, points: list[tuple[float, float, float]]) -> Lane:
    length_m = float(np.hypot(points[-1][0] - points[0][0], points[-1][1] - points[0][1]))
    return Lane(
        id=name, edge=name.split("_")[0], width_m=3.5, speed_mps=13.9, length_m=length_m,
        centreline=points,
    )  # fmt: skip


def street(climb_m: float = 0.0) -> RoadMap:
    """Two lanes either way along x, climbing eastwards, meet two lanes from the south."""
    lanes = []
    for k, y in enumerate((-1.75, -5.25)):
        lanes.append(lane(f"w_{k}", [(-160.0, y, -climb_m), (-10.0, y, -climb_m / 16)]))
        lanes.append(lane(f"e_{k}", [(10.0, y, climb_m / 16), (160.0, y, climb_m)]))
    for k, y in enumerate((1.75, 5.25)):
        lanes.append(lane(f"fe_{k}", [(160.0, y, climb_m), (10.0, y, climb_m / 16)]))
        lanes.append(lane(f"fw_{k}", [(-10.0, y, -climb_m / 16), (-160.0, y, -climb_m)]))
    for k, x in enumerate((-1.75, 1.75)):
        lanes.append(lane(f"s_{k}", [(x, -150.0, 0.0), (x, -10.0, 0.0)]))
    links = [
        Link(index=0, from_lane="w_0", to_lane="e_0"),
        Link(index=1, from_lane="fe_0", to_lane="fw_0"),
        Link(index=2, from_lane="s_0", to_lane="e_0"),
    ]
    corners = [(-10.0, -10.0), (10.0, -10.0), (10.0, 7.0), (-10.0, 7.0)]
    return RoadMap(
        name="street", centre=(0.0, 0.0, 0.0), lanes=lanes, junction=corners,
        signal=Signal(tls="t", links=links, conflicts=[(0, 2)], plan=[]),
    )  # fmt: skip


def unit_box() -> TriangleMesh:
    return extrude([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], 0.0, 1.0)


def unit_wedge() -> TriangleMesh:
    """A box with a smaller one upon it: a car, roughly."""
    base = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    cabin = [(-0.35, -0.45), (0.25, -0.45), (0.25, 0.45), (-0.35, 0.45)]
    return merge([extrude(base, 0.0, 0.55), extrude(cabin, 0.55, 1.0, taper=0.7)])


@pytest.fixture(scope="session")
def road_map() -> RoadMap:
    return street(climb_m=4.0)


@pytest.fixture(scope="session")
def scene(road_map: RoadMap) -> Scene:
    return build_scene(road_map, SceneConfig(), SEED)


@pytest.fixture(scope="session")
def shapes() -> VehicleShapes:
    car = VehicleType(name="car", mesh="wedge", length_m=4.6, width_m=1.8, height_m=1.5)
    bus = VehicleType(name="bus", mesh="box", length_m=12.0, width_m=2.5, height_m=3.0)
    return VehicleShapes([car, bus], {"box": unit_box(), "wedge": unit_wedge()})


@pytest.fixture(scope="session")
def traffic(scene: Scene) -> tuple[np.ndarray, list[str]]:
    """Poses (70, 6) and types of a full street; the first stands beside the junction."""
    rng = np.random.default_rng(3)
    x = np.concatenate([[-15.0], rng.uniform(-130, 130, 69)])
    y = np.concatenate([[-1.75], rng.choice([-5.25, -1.75, 1.75, 5.25], 69)])
    yaw = np.where(y < 0, 0.0, np.pi) + rng.normal(0, 0.05, 70)
    types = ["bus" if k % 9 == 5 else "car" for k in range(70)]
    return scene.terrain.body_poses(x, y, yaw), types
