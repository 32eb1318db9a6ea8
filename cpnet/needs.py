"""Checks that the packages of a run are installed, before anything is compiled or started."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

from cpnet.processes import MCAP, RoleSelection
from cpnet.scenario import Scenario
from perception.config import LEARNED
from protocol.errors import ConfigError
from protocol.extras import to_install

SUMO = ("sumo", "libsumo")
OPEN3D = ("open3d",)
_LEARNED = ("torch", "safetensors"), "learn"
_OF_DETECTORS = {"reference": (OPEN3D, "reference"), **dict.fromkeys(LEARNED, _LEARNED)}


def check_run(choice: RoleSelection, scenario: Scenario, *, detects: bool) -> None:
    """Checks the packages that the roles of this machine need, the simulator's among them.

    Raises:
        ConfigError: a package is missing; the text says how to install it.
    """
    check_simulator(cuts=isinstance(scenario.regions, int) and scenario.regions > 1)
    if detects:
        check_detector(scenario.edge.detector)
    if MCAP in choice.roles and scenario.record.mcap:
        import recording.mcap  # noqa: F401 - says what to install, if it must be


def check_simulator(*, cuts: bool = False) -> None:
    """Checks that SUMO is installed, and what cuts a net into regions.

    Raises:
        ConfigError: a package is missing.
    """
    if lacking(SUMO):
        raise ConfigError(f"SUMO is not installed (extra `sim`): {to_install('sim')}")
    if cuts and lacking(["pymetis"]):
        raise ConfigError(f"regions need pymetis (extra `sim`): {to_install('sim')}")


def check_detector(name: str) -> None:
    """Checks the packages of a built-in detector.

    Raises:
        ConfigError: a package is missing.
    """
    packages, extra = _OF_DETECTORS.get(name, ((), ""))
    if missing := lacking(packages):
        needed = " and ".join(missing)
        raise ConfigError(
            f"the detector {name} needs {needed} (extra `{extra}`): {to_install(extra)}"
        )


def lacking(packages: Iterable[str]) -> list[str]:
    """Returns those that are not installed."""
    return [name for name in packages if find_spec(name) is None]
