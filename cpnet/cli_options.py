"""What commands share: where they print, options that several have."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Protocol, TypeVar

import typer
from rich.console import Console
from rich.progress import track

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


def show_measured(
    rows: Iterable[R],
    total: int | None,
    print_table: Callable[[list[R], Console], None],
    *,
    as_json: bool,
) -> None:
    """Prints rows once all are there; if something ends it before, those that are."""
    done: list[R] = []
    try:
        for row in track(rows, "measuring", total, console=errors, transient=True):
            done.append(row)  # noqa: PERF402 - those before an error are wanted too
    finally:
        if done:
            show(done, print_table, as_json=as_json)


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
