"""Findings of `cpnet doctor`, as a table and for programs."""

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
    """Result of one check: what was checked, whether it is well, and what to do if not.

    `check` never changes its name; what was measured stands in `measured`, with its unit. What is
    `absent` is not installed, and not every machine needs it.
    """

    check: str
    what: str
    ok: bool
    advice: str = ""
    optional: bool = False
    measured: Measured = field(default_factory=dict)
    absent: bool = False

    @property
    def is_well(self) -> bool:
        """Whether a run is possible: all required checks are well."""
        return self.ok or self.optional


def print_findings(findings: Iterable[Finding], console: Console) -> None:
    """Prints a line per check."""
    table = Table(box=None, show_header=False)
    for finding in findings:
        table.add_row(_mark(finding), escape(finding.what), escape(finding.advice))
    console.print(table)


def _mark(finding: Finding) -> str:
    if finding.absent:
        return "--"
    if finding.ok:
        return "[green]ok[/]"
    return "[yellow]hint[/]" if finding.optional else "[red]fault[/]"


def findings_as_json(findings: list[Finding]) -> dict[str, Any]:
    """Returns the findings by stable keys."""
    well = all(finding.is_well for finding in findings)
    return {"ok": well, "findings": [asdict(finding) for finding in findings]}
