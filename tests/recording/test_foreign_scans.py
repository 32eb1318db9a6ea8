"""Imported scans, from files to detected vehicles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cpnet.replay import Pace, Scans, replay_of_scans
from protocol.errors import ConfigError
from protocol.geometry import SE3
from recording.foreign_scans.agents import Source, agents_of
from recording.foreign_scans.importer import ImportedScans
from recording.run import Run
from recording.tables import CountRow, DetectionRow, FrameRow, RequestRow
from studies.box_files import write_boxes
from studies.in_process import run_setup_in_process
from studies.summary import print_report, summarise
from tests import places

pytest.importorskip("mcap", reason="needs the extra `mcap`")


SHARED = Path(__file__).parents[3] / "shared" / "data" / "lidar" / "car_three_lidars"
CARS = [(9.0, 3.0, 0.1), (-8.0, -5.0, 0.0)]


def played(folder: Path, asked: Scans) -> Path:
    made = replay_of_scans(asked, Pace(), Console())
    folder.mkdir()
    run_setup_in_process(made.setup(folder), folder)
    return folder


def near(run_dir: Path, places_m: list[tuple[float, float]], frame: int) -> list[float]:
    """Returns how far from each place the nearest detected box is."""
    with Run(run_dir) as run:
        found = [(row.x_m, row.y_m) for row in run.of_frame(DetectionRow, frame)]
    return [min(float(np.hypot(x - u, y - v)) for u, v in found) for x, y in places_m]


def test_a_driving_cars_scans_show_the_vehicles_around_it(tmp_path):
    points = places.scene(CARS)
    for frame in range(3):
        sensor = SE3.from_pose([1000 + frame, 2000, 52, 0, 0, 0.2])
        moved = points + np.array([1000, 2000, 50])
        places.write_bin(tmp_path / "drive" / f"{frame:06}.bin", places.seen(moved, sensor))
    rows = [f"{7 + frame * 0.1:.3f},{1000 + frame},2000,52,{np.degrees(0.2)}" for frame in range(3)]
    table = tmp_path / "poses.csv"
    table.write_text("\n".join(["time_s,x_m,y_m,z_m,yaw_deg", *rows]))
    made = replay_of_scans(Scans(Source(tmp_path / "drive", table), None, {}), Pace(), Console())
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    run_setup_in_process(made.setup(run_dir), run_dir)
    with Run(run_dir) as run:
        frames = [*run.rows(FrameRow)]
        assert [frame.sim_time_ns for frame in frames] == [0, 100_000_000, 200_000_000]
        assert all(frame.complete and frame.agents == 1 for frame in frames)
        assert [*run.rows(CountRow)] == []
        assert {row.state for row in run.rows(RequestRow)} == {"G"}
    assert made.sensor_poses is not None
    assert write_boxes(run_dir, tmp_path / "boxes", made.sensor_poses) >= 6
    assert sorted(path.name for path in (tmp_path / "boxes").iterdir())[-1] == "000002.txt"
    summary = summarise(run_dir)
    assert summary["found_per_frame"]["car"] >= 2
    shown = Console(width=100, record=True)
    print_report(summary, shown)
    assert "detected a frame" in shown.export_text()
    for frame in range(3):  # the map's origin is the first pose
        assert max(near(run_dir, [(x, y) for x, y, _ in CARS], frame)) < 0.7


def test_one_frame_of_several_sensors_is_merged_and_played_as_often_as_asked(tmp_path):
    points = places.scene(CARS)
    vehicle = SE3.from_pose([0, 0, 1.8, 0, 0, 0])
    mounts = {"top": SE3.identity(), "side": SE3.from_pose([0.1, 0.5, -0.3, 0, 0.7, 1.5])}
    for name, mount in mounts.items():
        places.write_pcd(
            tmp_path / "car" / f"{name}-0001.pcd", places.seen(points, vehicle @ mount)
        )
    poses, extrinsics = tmp_path / "poses.txt", tmp_path / "guess.csv"
    poses.write_text("0 0 1.8 0 0 0\n")
    extrinsics.write_text("sensor,x_m,y_m,z_m,yaw_deg\ntop,0,0,0,0\nside,0.3,0.2,0,80\n")
    source = Source(tmp_path / "car", poses, extrinsics, refine=True)
    run_dir = played(tmp_path / "run", Scans(source, None, {}, frames=2))
    with Run(run_dir) as run:
        assert len([*run.rows(FrameRow)]) == 2
    assert max(near(run_dir, [(x, y) for x, y, _ in CARS], 1)) < 0.7
    assert "side" in (run_dir / "extrinsics.csv").read_text()


def test_several_agents_have_folders_and_tracks_of_their_own(tmp_path):
    points = places.scene(CARS)
    sensors = {
        "ego": SE3.from_pose([0, 0, 2, 0, 0, 0]),
        "other": SE3.from_pose([-14, 2, 2, 0, 0, 0]),
    }
    for name, sensor in sensors.items():
        places.write_bin(
            tmp_path / "all" / name / "velodyne" / "1.bin", places.seen(points, sensor)
        )
        pose = sensor.as_pose()
        (tmp_path / "oxts" / name).mkdir(parents=True)
        (tmp_path / "oxts" / name / "1.txt").write_text(" ".join(map(str, pose)))
    source = Source(tmp_path / "all", tmp_path / "oxts")
    run_dir = played(tmp_path / "run", Scans(source, None, {"link.profile": "50mbit"}, frames=2))
    with Run(run_dir) as run:
        assert [frame.agents for frame in run.rows(FrameRow)] == [2, 2]
    assert max(near(run_dir, [(9, 3), (-8, -5), (-14, 2), (0, 0)], 1)) < 0.7


def test_poses_that_do_not_fit_the_scans_are_refused(tmp_path):
    places.write_bin(tmp_path / "a" / "1.bin", np.ones((3, 3)))
    places.write_bin(tmp_path / "a" / "2.bin", np.ones((3, 3)))
    places.write_bin(tmp_path / "b" / "x" / "1.bin", np.ones((3, 3)))
    places.write_bin(tmp_path / "b" / "y" / "1.bin", np.ones((3, 3)))
    poses = tmp_path / "p.csv"
    poses.write_text("x_m,y_m,z_m\n0,0,0\n0,0,0\n0,0,0\n")
    with pytest.raises(
        ConfigError, match=r"has 3 poses for the 2 scans of a; needs as many, or one"
    ):
        agents_of(Source(tmp_path / "a", poses))
    with pytest.raises(ConfigError, match=r"has no poses of the agent 'x'; .* the column agent"):
        agents_of(Source(tmp_path / "b", poses))


def two_agents(folder: Path, times: str) -> Source:
    """Returns two frames of each of two agents, and a table of when they were."""
    for name in ("a", "b"):
        for frame in range(2):
            places.write_bin(folder / "all" / name / f"{frame}.bin", places.scene(walls=False))
    (folder / "p.csv").write_text("agent,time_s,x_m,y_m,z_m\n" + times)
    return Source(folder / "all", folder / "p.csv")


def test_agents_that_were_timed_by_other_clocks_are_refused(tmp_path):
    source = two_agents(tmp_path, "a,5,0,0,2\na,5.1,0,0,2\nb,5.04,9,0,2\nb,5.16,9,0,2\n")
    with pytest.raises(ConfigError, match=r"p\.csv: agents a and b have other times in frame 1"):
        replay_of_scans(Scans(source, None, {}), Pace(), Console())


def test_the_times_are_those_of_an_agent_that_has_them(tmp_path):
    source = two_agents(tmp_path, "a,5,0,0,2\nb,7,9,0,2\nb,7.2,9,0,2\n")
    agents = agents_of(source)
    assert ImportedScans.of(agents, None, 2.0).times_ns(100_000_000) == [0, 200_000_000]
    assert ImportedScans.of(agents, 3, 2.0).times_ns(100_000_000) == [0, 100_000_000, 200_000_000]


def test_a_first_cloud_without_a_point_is_refused_and_later_ones_are_counted(tmp_path, capsys):
    source = two_agents(tmp_path, "a,5,0,0,2\nb,5,9,0,2\n")
    places.write_bin(tmp_path / "all" / "b" / "1.bin", np.full((3, 3), np.nan))
    replay_of_scans(Scans(source, None, {}), Pace(), Console()).setup(tmp_path)
    assert "1 of 4 clouds hold no point" in capsys.readouterr().out
    places.write_bin(tmp_path / "all" / "b" / "0.bin", np.full((3, 3), np.inf))
    with pytest.raises(ConfigError, match=r"0\.bin: holds no point"):
        replay_of_scans(Scans(source, None, {}, height_m=2.0), Pace(), Console())


@pytest.mark.parametrize(
    ("asked", "error_text"),
    [
        ({"overrides": {"duration_s": 2.0}}, "--set duration_s: with --scans that follows"),
        ({"overrides": {"upload.policy": "reap"}}, "--set upload.policy: .* changes nothing"),
        ({"overrides": {"lidar.vehicle.channels": 16}}, "--set lidar.vehicle.channels: with"),
        ({"height_m": float("nan")}, "--height nan: must be 0 to 100 m"),
        ({"height_m": 1e8}, r"--height 1e\+08: must be"),
    ],
)
def test_what_scans_cannot_be_played_with_is_refused(tmp_path, asked, error_text):
    source = two_agents(tmp_path, "a,5,0,0,2\nb,5,9,0,2\n")
    with pytest.raises(ConfigError, match=error_text):
        replay_of_scans(Scans(source, None, **{"overrides": {}} | asked), Pace(), Console())


def test_a_folder_whose_name_no_agent_can_have_is_named(tmp_path):
    agents = agents_of(two_agents(tmp_path, "a,5,0,0,2\nb,5,9,0,2\n"))
    with pytest.raises(ConfigError, match="agent 'xxx.*must have 1 to 128 visible"):
        ImportedScans.of([replace(agents[0], name="x" * 200)], None, None)
    with pytest.raises(ConfigError, match="agent 'lidar': boxes found in points are named so"):
        ImportedScans.of([replace(agents[0], name="lidar")], None, None)
    places.write_bin(tmp_path / "sensors" / "lidar" / "1.bin", np.ones((3, 3)))
    (tmp_path / "one.txt").write_text("0 0 0 0 0 0\n")
    (agent,) = agents_of(Source(tmp_path / "sensors" / "lidar", tmp_path / "one.txt"))
    assert agent.name == "agent"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real car's scans are not on this machine")
def test_the_real_cars_three_lidars_lie_over_one_another(tmp_path):
    poses = tmp_path / "poses.csv"
    poses.write_text("x_m,y_m,z_m\n0,0,2\n")
    names = ["top", "left", "right"]
    source = Source(SHARED, poses, SHARED / "initial_extrinsic.txt", names, refine=True)
    run_dir = played(tmp_path / "run", Scans(source, None, {}, frames=1))
    with Run(run_dir) as run:
        (frame,) = run.rows(FrameRow)
        assert frame.complete
        assert frame.points == 110_497
        found = [*run.of_frame(DetectionRow, 0)]
    own = [row for row in found if row.source == "car_three_lidars"]
    assert len(own) == 1
    (agent,) = agents_of(source)
    for name, pitch_deg in (("left", 45), ("right", 45)):
        assert np.degrees(agent.mounts[name].as_pose()[4]) == pytest.approx(pitch_deg, abs=1.5)
