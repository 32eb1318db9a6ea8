"""The scripts in examples/ run as their first lines say."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import TIMEOUT_S

pytestmark = pytest.mark.process

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(name: str, *arguments: str, cwd: Path) -> str:
    path = os.pathsep.join(filter(None, [str(EXAMPLES.parent), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_sweep_prints_what_each_policy_and_link_gives(tmp_path) -> None:
    options = ["--duration", "2", "--channels", "16", "--links", "1mbit,20ms"]
    printed = run_example("bandwidth_sweep.py", *options, cwd=tmp_path)
    rows = [line.split("┆") for line in printed.splitlines() if "mbit" in line]
    assert [row[1].strip() for row in rows] == ["1mbit,20ms"] * 2
    full, foreground = (float(rows[index][3]) for index in (0, 1))
    assert 0 < foreground < full / 3


def test_a_detector_of_ones_own_sees_vehicles(tmp_path) -> None:
    printed = run_example("own_detector.py", "--duration", "2", "--channels", "16", cwd=tmp_path)
    *frames, own, fast = printed.splitlines()
    assert len(frames) == 4
    assert own.split()[0] == "squares"
    for line in (own, fast):
        assert float(line.split()[2]) > 50


def test_a_controller_of_ones_own_is_compared(tmp_path) -> None:
    options = ["--duration", "5", "--seeds", "1", "--channels", "16"]
    printed = run_example("own_controller.py", *options, cwd=tmp_path)
    assert [line.split()[0] for line in printed.splitlines()] == [
        "soonest",
        "max_pressure",
        "fixed",
    ]


def test_an_agent_is_trained_and_beats_chance(tmp_path) -> None:
    pytest.importorskip("gymnasium")
    options = ["--seconds", "6", "--episode", "60", "--seeds", "1"]
    printed = run_example("train_signal.py", *options, cwd=tmp_path)
    _, chance, trained = printed.splitlines()
    assert float(trained.split()[1]) < float(chance.split()[1])


def test_every_script_is_run_by_a_test_of_this_file() -> None:
    text = Path(__file__).read_text("utf-8")
    scripts = [path.name for path in EXAMPLES.glob("*.py")]
    assert scripts
    assert [name for name in scripts if name not in text] == []


@pytest.mark.parametrize("package", [p.parent.name for p in EXAMPLES.glob("*/pyproject.toml")])
def test_every_example_package_is_shown_in_the_docs(package) -> None:
    assert f"examples/{package}/" in (EXAMPLES.parent / "docs" / "plugins.md").read_text("utf-8")
