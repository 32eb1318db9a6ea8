"""Installation commands for optional extras whose packages are missing."""

from __future__ import annotations

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires, version

DISTRIBUTION = "cpnet-edge"


def to_install(extra: str) -> str:
    """Returns the command that installs the packages of an extra that are missing here.

    It lists the packages instead of the extra: cpnet may come from a clone, a wheel or an index.
    """
    wanted = [text.partition(";") for text in requires(DISTRIBUTION) or ()]
    found = [need.strip() for need, _, marker in wanted if _names(marker, extra)]
    missing = [need for need in found if not _is_installed(need)]
    return shlex.join([sys.executable, "-m", "pip", "install", *(missing or found)])


def _names(marker: str, extra: str) -> bool:
    return marker.replace('"', "'").replace(" ", "").endswith(f"extra=='{extra}'")


def _is_installed(need: str) -> bool:
    name = need
    for sign in "<>=!~[ ":
        name = name.partition(sign)[0]
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True
