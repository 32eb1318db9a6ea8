"""Ground of imported scans: slopes, and poses without them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import places
import pytest
from rich.console import Console

from cpnet.replay import Pace, Scans, replay_of_scans
from protocol.geometry import SE3
from recording.foreign_scans.agents import Source
from recording.foreign_scans.ground import Ground
from recording.run import Run
from recording.tables import DetectionRow
from studies.in_process import run_setup_in_process

pytest.importorskip("mcap", reason="needs the extra `mcap`")

CARS = [(9.0, 3.0, 0.1), (-8.0, -5.0, 0.0), (16.0, -8.0, 0.3), (-18.0, 6.0, 0.2), (3.0, 10.0, 0.1)]
FOOT = np.array([[x, y, 0.0] for x, y, _ in CARS])


def tilted(roll_deg: float, pitch_deg: float) -> SE3:
    """Turns a level world about its origin."""
    return SE3.from_pose([0, 0, 0, *np.radians([roll_deg, pitch_deg]), 0])


def played(folder: Path, world: SE3, sensor: SE3) -> tuple[list[float], int, str]:
    """Plays what a sensor sees of a turned world; the map's origin is the sensor.

    Returns how far from each car the nearest box is, how many boxes there are, and what was
    printed.
    """
    seen = places.seen(world.apply(places.scene(CARS)), sensor)
    places.write_bin(folder / "drive" / "0.bin", seen)
    (folder / "poses.txt").write_text(" ".join(f"{number:.6f}" for number in sensor.as_pose()))
    console = Console(record=True, width=300)
    source = Source(folder / "drive", folder / "poses.txt")
    made = replay_of_scans(Scans(source, None, {}, frames=2), Pace(), console)
    run_dir = folder / "run"
    run_dir.mkdir()
    run_setup_in_process(made.setup(run_dir), run_dir)
    with Run(run_dir) as run:
        found = [(row.x_m, row.y_m) for row in run.of_frame(DetectionRow, 1)]
    cars = world.apply(FOOT)[:, :2] - sensor.translation[:2]
    near = [float(np.hypot(*(np.array(found).reshape(-1, 2) - car).T).min()) for car in cars]
    return near, len(found), console.export_text()


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0, 0), (3, 0), (0, -3), (6, 0), (4, 4.5)])
@pytest.mark.parametrize("stands", ["on the slope", "upright"])
def test_a_scan_on_a_slope_shows_the_vehicles_that_a_level_one_shows(
    tmp_path: Path, roll_deg: float, pitch_deg: float, stands: str
) -> None:
    world = tilted(roll_deg, pitch_deg)
    sensor = world @ SE3.from_pose([0, 0, 2.0, 0, 0, 0])
    if stands == "upright":
        sensor = SE3(np.eye(3), sensor.translation)
    near, boxes, printed = played(tmp_path, world, sensor)
    assert max(near) < 0.7
    assert boxes <= len(CARS) + 3  # the agent itself, and what is left of walls
    assert float(printed.split("slopes up to ")[1].split()[0]) == pytest.approx(
        np.degrees(np.arccos(world.rotation[2, 2])), abs=0.5
    )
    assert "badly" not in printed


def test_where_poses_contradict_one_another_the_ground_fits_badly() -> None:
    points = places.scene(CARS)
    scans = [
        (
            places.seen(points, SE3.from_pose([x, 0, 2.0, 0, 0, 0])),
            SE3.from_pose([x, 0, z, 0, 0, 0]),
        )
        for x, z in ((0.0, 2.0), (1.0, 2.4), (2.0, 1.6))
    ]
    line = np.array([[-30.0, 0.0], [30.0, 0.0]])
    assert Ground.of(scans[:1], [line], 60.0).fit > 0.95
    assert "fits badly" in str(Ground.of(scans, [line], 60.0))


def test_the_ground_follows_a_hill() -> None:
    x, y = np.random.default_rng(1).uniform(-40, 40, (2, 40_000))

    def hill_m(places: np.ndarray) -> np.ndarray:
        return np.asarray(3.0 * np.cos(places[:, 0] / 25) + 0.05 * places[:, 1])

    floor = np.column_stack([x, y, hill_m(np.column_stack([x, y]))])
    sensor = SE3.from_pose([0, 0, hill_m(np.zeros((1, 2)))[0] + 2.0, 0, 0, 0.5])
    line = np.array([[-30.0, 0.0], [30.0, 0.0]])
    ground = Ground.of([(places.seen(floor, sensor), sensor)], [line], 40.0)
    at = np.column_stack([np.linspace(-30, 30, 50), np.linspace(-15, 15, 50)])
    assert np.abs(ground.height_m(at) - hill_m(at)).max() < 0.2
