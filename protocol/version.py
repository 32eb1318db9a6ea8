"""Which cpnet this is."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def own_version() -> str:
    """Returns the installed version, `unknown` in a checkout that was never installed."""
    try:
        return version("cpnet-edge")
    except PackageNotFoundError:
        return "unknown"
