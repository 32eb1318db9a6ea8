"""What a check found, for people and for programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

Measured = Mapping[str, float | str | list[str]]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, whether it is well, and what to do if not.

    `check` never changes its name; what was measured stands in `measured`, with its unit.
    """

    check: str
    what: str
    ok: bool
    advice: str = ""
    optional: bool = False
    measured: Measured = field(default_factory=dict)

    @property
    def is_well(self) -> bool:
        """Whether a run can do: all is well, or only what it may lack is not."""
        return self.ok or self.optional


def print_findings(findings: Iterable[Finding], console: Console) -> None:
    """Prints a line per check."""
    table = Table(box=None, show_header=False)
    for finding in findings:
        absent = "[yellow]hint[/]" if finding.optional else "[red]fault[/]"
        mark = "[green]ok[/]" if finding.ok else absent
        table.add_row(mark, escape(finding.what), escape(finding.advice))
    console.print(table)


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """Returns the findings by stable keys."""
    well = all(finding.is_well for finding in findings)
    return {"ok": well, "findings": [asdict(finding) for finding in findings]}
