"""What commands share: where they print, options that several have."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any, Protocol, TypeVar

import typer
from rich.console import Console

from cpnet import scenario as scenarios

console = Console()
errors = Console(stderr=True)

Override = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="any scenario key; `cpnet scenario` shows all"),
]
AsJson = Annotated[bool, typer.Option("--json", help="stable keys, for programs")]


class Row(Protocol):
    """A row of a measurement."""

    def as_json(self) -> dict[str, Any]:
        """Returns its figures by stable keys."""


R = TypeVar("R", bound=Row)


def show(rows: list[R], print_table: Callable[[list[R], Console], None], *, as_json: bool) -> None:
    """Prints rows for people or for programs."""
    if as_json:
        typer.echo(json.dumps([row.as_json() for row in rows], indent=2))
    else:
        print_table(rows, console)


def assigned(texts: list[str] | None) -> dict[str, Any]:
    """Returns the keys and values of `--set`.

    Raises:
        ConfigError: a text is no assignment.
    """
    return dict(scenarios.parse_assignment(text) for text in texts or [])
