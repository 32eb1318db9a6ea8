"""Agents whose poses are wrong: what they see lies elsewhere than what others see."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import places
import pytest
from rich.console import Console

from cpnet.replay import Pace, Scans, replay_of_scans
from protocol.geometry import SE3
from recording.foreign_scans.agents import Source, agents_of
from recording.foreign_scans.mutual import misplaced

SHARED = Path(__file__).parents[3] / "shared" / "data" / "lidar" / "car_three_lidars"
CARS = [(9.0, 3.0, 0.1), (-8.0, -5.0, 0.0), (16.0, -8.0, 0.3), (-18.0, 6.0, 0.2)]
TRUE = {"a": (0, 0, 2, 0, 0, 0.3), "b": (-12, 1, 2, 0, 0, -0.2), "c": (8, -3, 2, 0, 0, 2.0)}


def written(folder: Path, names: str, **off: tuple[float, float, float, float]) -> Source:
    """Writes what agents see; poses of those that are named are off by x, y, z in m, yaw in deg."""
    points = places.scene(CARS)
    (folder / "poses").mkdir()
    for name in names:
        pose = np.array(TRUE[name], float)
        places.write_bin(folder / "all" / name / "0.bin", places.seen(points, SE3.from_pose(pose)))
        x, y, z, yaw = off.get(name, (0, 0, 0, 0))
        pose += [x, y, z, 0, 0, np.radians(yaw)]
        (folder / "poses" / name).mkdir()
        (folder / "poses" / name / "0.txt").write_text(" ".join(map(str, pose)))
    return Source(folder / "all", folder / "poses")


def test_agents_in_place_are_not_named(tmp_path: Path) -> None:
    assert misplaced(agents_of(written(tmp_path, "abc", b=(0.05, -0.05, 0.02, 0.1)))) == []


@pytest.mark.parametrize("who", ["a", "b", "c"])
@pytest.mark.parametrize("off", [(1.2, -0.9, 0.2, 0.0), (-0.4, 1.9, 0.0, 1.5)])
def test_of_three_agents_the_one_that_is_off_is_named_and_by_how_much(
    tmp_path: Path, who: str, off: tuple[float, float, float, float]
) -> None:
    (found,) = misplaced(agents_of(written(tmp_path, "abc", **{who: off})))
    assert found.agent == who
    assert found.offset[:3] == pytest.approx(off[:3], abs=0.12)
    assert np.degrees(found.offset[3]) == pytest.approx(off[3], abs=0.3)
    assert found.after > 0.8 > found.before + 0.1


def test_of_two_agents_one_is_moved_to_the_other(tmp_path: Path) -> None:
    (found,) = misplaced(agents_of(written(tmp_path, "ab", a=(1.5, 0.5, 0, 0))))
    side = {"a": 1.0, "b": -1.0}[found.agent]
    assert found.offset[:2] == pytest.approx([1.5 * side, 0.5 * side], abs=0.12)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real car's scans are not on this machine")
def test_real_clouds_with_poses_that_are_off_are_found_and_moved_back(tmp_path: Path) -> None:
    (tmp_path / "car.csv").write_text("x_m,y_m,z_m\n0,0,2\n")
    names, guess = ["top", "left", "right"], SHARED / "initial_extrinsic.txt"
    (car,) = agents_of(Source(SHARED, tmp_path / "car.csv", guess, names, refine=True))
    off = {"left": (1.2, -0.8, 0, 0, 0, 0), "right": (-0.5, 1.4, 0, 0, 0, np.radians(1.5))}
    for name, mount in car.mounts.items():
        pose = mount.as_pose() + np.array([0, 0, 2, 0, 0, 0]) + off.get(name, np.zeros(6))
        for folder in ("all", "poses"):
            (tmp_path / folder / name).mkdir(parents=True)
        (tmp_path / "all" / name / "0.pcd").symlink_to(SHARED / f"{name}.pcd")
        (tmp_path / "poses" / name / "0.txt").write_text(" ".join(map(str, pose)))
    found = misplaced(agents_of(Source(tmp_path / "all", tmp_path / "poses")))
    assert {one.agent for one in found} == off.keys()
    for one in found:
        assert one.offset[:2] == pytest.approx(off[one.agent][:2], abs=0.1)
        assert one.before < 0.2
        assert one.after > 0.7


def test_a_replay_says_who_is_off_and_moves_it_if_asked(tmp_path: Path) -> None:
    source = written(tmp_path, "abc", b=(1.2, -0.9, 0, 0))
    console = Console(record=True, width=400)
    replay_of_scans(Scans(source, None, {}), Pace(), console)
    text = console.export_text()
    (off_m,) = re.findall(r"agent b: what it sees lies ([\d.]+) m", text)
    assert float(off_m) == pytest.approx(1.5, abs=0.05)
    assert "--align does it" in text
    replay_of_scans(Scans(source, None, {}, align=True), Pace(), console)
    assert "they are" in console.export_text()


def test_agents_that_see_nothing_together_are_left_alone(tmp_path: Path) -> None:
    assert misplaced(agents_of(written(tmp_path, "ab", b=(400, 0, 0, 0)))) == []
