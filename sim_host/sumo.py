"""Where SUMO's programs and data lie, and how its tools are run."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from protocol.errors import ConfigError

_NETCONVERT_TIMEOUT_S = 60


def sumo_home() -> Path:
    """Returns the folder of the eclipse-sumo wheel.

    Raises:
        ConfigError: it is not installed.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError("SUMO is not installed: pip install 'cpnet-edge[sim]'")
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
            f"libsumo cannot be loaded: {error}; pip install 'cpnet-edge[sim]', and see "
            "`cpnet doctor` for system libraries"
        ) from None


def netconvert(arguments: Sequence[str]) -> None:
    """Runs netconvert; coordinates stay as they are given.

    Raises:
        ConfigError: it is missing or fails; the text holds what it said.
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
