"""The scripts in examples/ run as their first lines say."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_script_compares_two_upload_policies_on_the_same_traffic(tmp_path) -> None:
    printed = run_example("upload_policies.py", "--duration", "3", "--channels", "16", cwd=tmp_path)
    full, foreground = (line.split() for line in printed.splitlines())
    assert [full[0], foreground[0]] == ["full", "foreground"]
    for e_cvpr_percent in (float(full[3]), float(foreground[3])):
        assert 50 < e_cvpr_percent <= 100
    full_mbps, foreground_mbps = float(full[5]), float(foreground[5])
    assert 0 < foreground_mbps < full_mbps / 3


def test_every_script_is_run_by_a_test_of_this_file() -> None:
    text = Path(__file__).read_text("utf-8")
    scripts = [path.name for path in EXAMPLES.glob("*.py")]
    assert scripts
    assert [name for name in scripts if name not in text] == []


@pytest.mark.parametrize("package", [p.parent.name for p in EXAMPLES.glob("*/pyproject.toml")])
def test_every_example_package_is_shown_in_the_docs(package) -> None:
    assert f"examples/{package}/" in (EXAMPLES.parent / "docs" / "plugins.md").read_text("utf-8")
