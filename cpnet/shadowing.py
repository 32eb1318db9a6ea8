"""Detects a user's module, such as `protocol.py`, that shadows a package of cpnet.

cpnet's packages have plain names. A file of such a name in the folder of a script, in the current
one under `python -m`, or on PYTHONPATH comes first, and the error that follows names neither. What
was checked holds for this process; processes that it starts are given the same path.
"""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

PACKAGES = (
    *("cpnet", "protocol", "perception", "sensing", "sim_host", "vehicle_agent", "infra_agent"),
    *("edge_server", "link_relay", "v2x_router", "signal_controller", "recording", "learning"),
    *("studies", "viewer"),
)
ROOT = Path(__file__).resolve().parents[1]


def same_path() -> dict[str, str]:
    """Returns the environment in which a new interpreter finds the same modules as this one.

    By itself, `python -c` and `python -m` would look in the current folder first.
    """
    folders = [os.path.abspath(folder) for folder in sys.path]  # noqa: PTH100 - "" is a folder
    return {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(folders)}


def check_packages() -> None:
    """Checks that no package of cpnet is shadowed: each is the one beside this.

    Raises:
        ImportError: another module hides one; the text names its file.
    """
    for name in PACKAGES:
        spec = find_spec(name)
        if spec is None:
            raise ImportError(f"cpnet's package {name} is missing in {ROOT}: install cpnet anew")
        places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
        found = Path(places[0]).resolve() if places else None
        if found is None or not found.is_relative_to(ROOT / name):
            raise ImportError(
                f"{found} hides cpnet's package {name}, which is in {ROOT / name}: rename it, or "
                "take its folder off PYTHONPATH, or start cpnet in another folder"
            )
