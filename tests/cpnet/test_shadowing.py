"""A user's own `protocol.py` is named at the start, not by an error deep inside."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cpnet.shadowing import PACKAGES, ROOT, check_packages


def test_all_packages_are_looked_for() -> None:
    assert set(PACKAGES) == {path.parent.name for path in ROOT.glob("*/py.typed")}
    check_packages()


@pytest.mark.parametrize("name", ["protocol.py", "studies/__init__.py", "viewer/notes.py"])
def test_a_module_that_hides_a_package_is_named(tmp_path, monkeypatch, name) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    code = "from cpnet.__main__ import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--version"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    package = name.partition("/")[0].removesuffix(".py")
    if name == "viewer/notes.py":  # a folder that is no package hides none
        assert done.returncode == 0
        return
    assert done.returncode == 2
    assert done.stderr.startswith(f"error {tmp_path / name} hides cpnet's package {package}")
    assert str(ROOT / package) in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_program_is_told_as_well(tmp_path) -> None:
    (tmp_path / "recording.py").touch()
    done = subprocess.run(
        [sys.executable, "-c", "import cpnet; cpnet.run"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert f"ImportError: {Path(tmp_path) / 'recording.py'} hides" in done.stderr
