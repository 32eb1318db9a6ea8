"""A user's own `protocol.py` is named at the start, not by an error deep inside."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cpnet.shadowing import PACKAGES, ROOT, check_packages, same_path


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


@pytest.mark.process
def test_the_current_folder_is_not_looked_through_by_processes_that_are_started(tmp_path) -> None:
    """The installed command does not look there either; `-P -c` stands for it."""
    (tmp_path / "protocol.py").write_text("raise RuntimeError('a file of the user')")
    (tmp_path / "modules").mkdir()
    script = "import os, protocol; print(protocol.__file__, os.environ.get('PYTHONSAFEPATH'))"
    (tmp_path / "modules" / "tell.py").write_text(script)
    code = """
from pathlib import Path
from cpnet.fork_server import preload, start_process
preload(["protocol.errors"], Path("logs/fork-server.log"))
raise SystemExit(start_process("tell", [], Path("logs/tell.log")).wait())
"""
    paths = os.pathsep.join([str(ROOT), str(tmp_path / "modules")])
    environment = os.environ | {"PYTHONPATH": paths}
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    logs = {path.name: path.read_text() for path in (tmp_path / "logs").iterdir()}
    assert done.returncode == 0, (done.stderr, logs)
    assert logs["tell.log"] == f"{ROOT / 'protocol' / '__init__.py'} None\n"


def test_a_new_interpreter_is_given_the_path_of_this_one(monkeypatch) -> None:
    monkeypatch.syspath_prepend("somewhere")
    code = "import sys; print(sys.path[0], sys.flags.safe_path)"
    shown = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | same_path(), capture_output=True, check=True
    )
    assert shown.stdout.decode().split() == [str(Path("somewhere").absolute()), "True"]
