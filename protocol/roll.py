"""Who answers a roll call of a bus: processes of this version of the protocol, and of others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from protocol.topics import OWN_VERSION


@dataclass(frozen=True, slots=True)
class Roll:
    """Ids of the processes that speak this side's version, and the versions of all others."""

    present: list[str]
    strangers: list[str]

    @classmethod
    def of(cls, rows: Iterable[tuple[str, str, str]]) -> Roll:
        """Reads version, role and id of all that answered."""
        rows = list(rows)
        present = [process for version, _, process in rows if version == OWN_VERSION]
        return cls(present, sorted({version for version, _, _ in rows} - {OWN_VERSION}))

    def misfit(self) -> str:
        """Returns what keeps this side from talking to the strangers, empty if there are none."""
        if not self.strangers:
            return ""
        theirs = ", ".join(map(_number, self.strangers))
        return (
            f"they speak version {theirs} of the protocol, this side {_number(OWN_VERSION)}: "
            "install the same cpnet on both"
        )


def _number(version: str) -> str:
    return version.removeprefix("v")
