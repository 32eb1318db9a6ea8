"""A small street, and boxes for vehicles."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.messages import VehicleType
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import VehicleShapes
from sensing.scene import Scene, build_scene
from tests.roads import street
from tests.sensing.solids import SEED, unit_box, unit_wedge


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
