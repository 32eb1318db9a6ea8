"""SUMO's programs and libraries. `python -m sim_host.sumo` tests them and prints the version."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from protocol.errors import ConfigError
from protocol.extras import to_install

_NETCONVERT_TIMEOUT_S = 60


def sumo_home() -> Path:
    """Returns the folder of the eclipse-sumo wheel.

    Raises:
        ConfigError: it is not installed.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError(f"SUMO is not installed: {to_install('sim')}")
    return Path(spec.submodule_search_locations[0])


def load_libsumo() -> ModuleType:
    """Imports libsumo, which takes half a second and may lack system libraries.

    Raises:
        ConfigError: it is not installed, or a shared library is missing; the text names it.
    """
    try:
        return importlib.import_module("libsumo")
    except ImportError as error:
        raise ConfigError(
            f"libsumo cannot be loaded: {error}; {to_install('sim')}, and see `cpnet doctor` for "
            "system libraries"
        ) from None


def netconvert(arguments: Sequence[str]) -> None:
    """Runs netconvert; coordinates stay as they are given.

    Raises:
        ConfigError: it is missing or fails; the message holds its output.
    """
    program = sumo_home() / "bin" / "netconvert"
    options = ["--no-turnarounds", "true", "--offset.disable-normalization", "true"]
    try:
        done = subprocess.run(
            [str(program), *arguments, *options],
            capture_output=True,
            text=True,
            timeout=_NETCONVERT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"netconvert does not run: {error}") from None
    if done.returncode != 0:
        raise ConfigError(f"netconvert failed: {done.stderr.strip()[-500:]}")


_NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="50" y="0"/></nodes>'
_EDGES = '<edges><edge id="ab" from="a" to="b"/></edges>'


def main() -> None:
    """Exits with status 1 and one line if SUMO does not run here."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            sys.stdout.write(f"{simulate_a_step(Path(folder))}\n")
    except ConfigError as error:
        sys.exit(str(error))


def simulate_a_step(folder: Path) -> str:
    """Returns SUMO's name and version.

    Raises:
        ConfigError: a program or library of it is missing or fails.
    """
    nodes, edges, net = (folder / f"{name}.xml" for name in ("nodes", "edges", "net"))
    nodes.write_text(_NODES)
    edges.write_text(_EDGES)
    netconvert(["-n", str(nodes), "-e", str(edges), "-o", str(net)])
    sumo = load_libsumo()
    try:
        quiet = ["--no-step-log", "true", "--xml-validation", "never"]
        sumo.start(["sumo", "--net-file", str(net), *quiet])
        sumo.simulationStep()
        version = str(sumo.getVersion()[1])
        sumo.close()
    except (sumo.TraCIException, sumo.FatalTraCIError) as error:
        raise ConfigError(f"SUMO does not simulate: {error}") from None
    return version


if __name__ == "__main__":
    main()
