"""What a run was made with."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from protocol.plugins import packages

PACKAGES = ("cpnet-edge", "eclipse-sumo", "eclipse-zenoh", "numpy", "numba", "embreex")


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that results depend on.

    Of the recording process, that is; a package that its machine lacks is left out, and those
    that bring plug-ins are among them, in use or not.
    """
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # another machine has it, or it runs from a checkout
            continue
    return found | packages()
