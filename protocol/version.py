"""Versions: of this cpnet, and of the protocol that the processes on a bus use."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from protocol.topics import OWN_VERSION


def own_version() -> str:
    """Returns the installed version, `unknown` in a checkout that was never installed."""
    try:
        return version("cpnet-edge")
    except PackageNotFoundError:
        return "unknown"


@dataclass(frozen=True, slots=True)
class PresentProcesses:
    """Ids of the processes with this side's protocol version, and the versions of all others."""

    present: list[str]
    other_versions: list[str]

    @classmethod
    def of(cls, rows: Iterable[tuple[str, str, str]]) -> PresentProcesses:
        """Reads version, role and id of all that answered."""
        rows = list(rows)
        present = [process for version, _, process in rows if version == OWN_VERSION]
        return cls(present, sorted({version for version, _, _ in rows} - {OWN_VERSION}))

    def mismatch(self) -> str:
        """Returns why this side is incompatible with the others, empty if all have its version."""
        if not self.other_versions:
            return ""
        theirs = ", ".join(map(_number, self.other_versions))
        return (
            f"they speak version {theirs} of the protocol, this side {_number(OWN_VERSION)}: "
            "install the same cpnet on both"
        )


def _number(version: str) -> str:
    return version.removeprefix("v")
