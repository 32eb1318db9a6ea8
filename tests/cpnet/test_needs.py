"""A package that a run lacks is named, with what installs it, before a minute goes into it."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from importlib import import_module

import pytest
from rich.console import Console

from cpnet import needs, preparation
from cpnet.preparation import Options, prepare_run
from protocol.errors import ConfigError


@pytest.fixture
def without(monkeypatch):
    """Makes packages count as not installed."""

    def take(*names: str) -> None:
        found = needs.find_spec
        monkeypatch.setattr(needs, "find_spec", lambda name: None if name in names else found(name))

    return take


@pytest.mark.parametrize(
    ("missing", "settings", "message"),
    [
        ("sumo", {}, "SUMO is not installed (extra `sim`): "),
        ("libsumo", {}, "SUMO is not installed (extra `sim`): "),
        ("pymetis", {"regions": 2}, "regions need pymetis (extra `sim`): "),
        ("open3d", {"edge.detector": "reference"}, "needs open3d (extra `reference`): "),
        ("torch", {"edge.detector": "pointpillars"}, "pointpillars needs torch (extra `learn`): "),
    ],
)
def test_a_run_is_refused_before_it_is_compiled_for(
    missing, settings, message, without, tmp_path, monkeypatch
) -> None:
    def never(_) -> None:
        raise AssertionError("it compiled first")

    without(missing)
    monkeypatch.setattr(preparation, "compile_ahead", never)
    monkeypatch.chdir(tmp_path)
    options = Options("corridor", settings, None, [], [], None)
    error_text = re.escape(f"{message}{sys.executable} -m pip install ")
    with pytest.raises(ConfigError, match=error_text):
        prepare_run(options, Console(file=io.StringIO()), None)
    assert list(tmp_path.iterdir()) == []


def test_a_run_in_a_program_names_them_too(without, tmp_path) -> None:
    from cpnet import python_api

    without("torch")
    with pytest.raises(ConfigError, match=r"needs torch \(extra `learn`\): .* -m pip install "):
        python_api.run(out=tmp_path / "run", **{"edge.detector": "pointpillars"})


def test_environments_without_their_packages_say_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "cpnet.environments", raising=False)
    with pytest.raises(ConfigError, match=r"need gymnasium \(extra `rl`\): .* -m pip install "):
        import_module("cpnet.environments")


@pytest.mark.parametrize("name", ["fast", "of-a-plug-in"])
def test_other_detectors_need_neither(name, without) -> None:
    without("open3d", "torch")
    needs.check_detector(name)


def test_the_command_line_starts_without_the_compiled_functions() -> None:
    code = (
        "import sys, cpnet.cli; print(*({'numba', 'scipy', 'libsumo', 'zenoh'} & {*sys.modules}))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []
