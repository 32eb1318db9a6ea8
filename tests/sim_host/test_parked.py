"""Parked cars."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.messages import Setup, is_bystander
from sensing.config import SceneConfig
from sensing.road import RoadArea
from sensing.terrain import Terrain
from sim_host.journeys import safe_id
from sim_host.presence import Fleet
from sim_host.setup import build_setup
from sim_host.ticks import TickPublisher
from sim_host.world import TrafficState

NOBODY = TrafficState(
    ids=[],
    types=[],
    lanes=[],
    poses=np.zeros((0, 6)),
    speeds_mps=np.zeros(0, np.float32),
    lane_positions_m=np.zeros(0, np.float32),
    equipment=np.zeros(0, np.uint8),
)


def street(folder: Path, seed: int = 1, **traffic: Any) -> Setup:
    return build_setup({"seed": seed, "traffic": {"parked_per_100m": 8, **traffic}}, folder)


@pytest.fixture(scope="module")
def parked(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return street(tmp_path_factory.mktemp("run"))


def footprints(setup: Setup) -> np.ndarray:
    """Returns the corners of the parked cars (P, 4, 2)."""
    sizes = {kind.name: (kind.length_m, kind.width_m) for kind in setup.vehicle_types}
    unit = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)])
    found = []
    for kind, pose in zip(setup.parked_types, setup.parked_poses, strict=True):
        cos, sin = np.cos(pose[5]), np.sin(pose[5])
        found.append(pose[:2] + unit * sizes[kind] @ np.array([[cos, sin], [-sin, cos]]))
    return np.array(found)


def test_there_are_as_many_as_asked_for(parked: Setup) -> None:
    kerb_m = sum(
        np.hypot(*np.diff(edge.points, axis=0).T).sum()
        for edge in RoadArea(parked.road_map).edges()
    )
    assert 0.6 * 8 < len(parked.parked_types) / (kerb_m / 100) <= 8  # junctions have none
    assert set(parked.parked_types) == {kind.name for kind in parked.vehicle_types}


def test_none_by_default(setup: Setup) -> None:
    assert setup.parked_types == []
    assert setup.parked_poses.shape == (0, 6)


def test_they_stand_beside_the_road_along_it_away_from_the_junction(parked: Setup) -> None:
    area = RoadArea(parked.road_map)
    corners = footprints(parked)
    aside_m = area.clearance_m(corners.reshape(-1, 2)).reshape(-1, 4)
    assert aside_m.min() > 0
    assert aside_m.min(axis=1).max() < 0.6  # near the kerb, and along it
    inner = [lane.points[:, :2] for lane in parked.road_map.lanes if lane.internal]
    apart = corners.reshape(-1, 1, 2) - np.concatenate(inner)
    assert np.linalg.norm(apart, axis=2).min() > 8
    terrain = Terrain(parked.road_map, SceneConfig(), 1)
    above_m = parked.parked_poses[:, 2] - terrain.height_m(parked.parked_poses[:, :2])
    np.testing.assert_allclose(above_m, SceneConfig().kerb_height_m, atol=0.05)


def test_they_do_not_meet(parked: Setup) -> None:
    middles = parked.parked_poses[:, :2]
    apart_m = np.linalg.norm(middles[:, None] - middles, axis=2) + np.eye(len(middles)) * 99
    assert apart_m.min() > 5.0  # of cars up to 4.9 m that stand in a row


def test_the_seed_draws_them_and_a_higher_density_keeps_those_of_a_lower(
    parked: Setup, tmp_path_factory: pytest.TempPathFactory
) -> None:
    def places(setup: Setup) -> set[tuple[float, ...]]:
        return {tuple(pose) for pose in setup.parked_poses.tolist()}

    same, other, fewer = (
        street(tmp_path_factory.mktemp("run"), seed, parked_per_100m=density)
        for seed, density in ((1, 8), (2, 8), (1, 3))
    )
    assert places(same) == places(parked)
    assert places(other).isdisjoint(places(parked))
    assert places(fewer) < places(parked)


def test_lorries_do_not_park(tmp_path: Path) -> None:
    kinds = [
        {"name": "lorry", "v_class": "truck", "mesh": "lorry", "length_m": 8.5, "height_m": 3.4},
        {"name": "car"},
    ]
    assert set(street(tmp_path, vehicles=kinds).parked_types) == {"car"}


class _Bus:
    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []

    def publish(self, topic: str, message: Any, **parts: str) -> None:
        self.sent.append((topic, message))


def test_they_are_in_the_ticks_but_are_no_traffic(parked: Setup) -> None:
    bus = _Bus()
    ticking = TickPublisher(bus, parked)  # type: ignore[arg-type]
    for frame in range(2):
        ticking.publish(frame, frame * 100_000_000, NOBODY, Fleet())
    tiles = [message for topic, message in bus.sent if topic == "bodies"]
    first, second = (message for topic, message in bus.sent if topic == "tick")
    names = [name for tile in tiles for name in tile.ids]
    assert sorted(names) == sorted(parked.parked_ids)  # sent once, for they do not move
    assert all(map(is_bystander, names))
    assert first.bodies == second.bodies == 0
    np.testing.assert_array_equal(second.since, 0)


def test_a_vehicle_whose_id_says_that_it_is_parked_is_called_otherwise() -> None:
    assert not is_bystander(safe_id("parked~3"))
    assert safe_id("parked") == "parked"
