"""Shared code of commands: output, and common options."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

import typer
from rich.console import Console
from rich.progress import track

from cpnet import scenario as scenarios
from cpnet.viewer_process import Viewing
from protocol.errors import ConfigError
from protocol.logs import LogStyle

console = Console()
errors = Console(stderr=True)

Override = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="any scenario key; `cpnet scenario` shows all"),
]
Out = Annotated[Path | None, typer.Option(help="run folder; default runs/NAME-TIME")]
_ADDRESS = "HOST:PORT, v2x=HOST:PORT or world=HOST:PORT"
Only = Annotated[
    str | None, typer.Option(metavar="ROLE,...", help="roles to run here, or vehicle-1")
]
Listen = Annotated[
    list[str] | None, typer.Option(metavar="PLACE", help=f"host the buses: {_ADDRESS}")
]
Connect = Annotated[
    list[str] | None, typer.Option(metavar="PLACE", help=f"buses elsewhere: {_ADDRESS}")
]
ServeMetrics = Annotated[
    str | None, typer.Option(metavar="PORT", help="serve Prometheus' metrics: PORT, HOST:PORT")
]
View = Annotated[Viewing | None, typer.Option(help="show it in Rerun, see `view`")]
Log = Annotated[LogStyle, typer.Option(help="what a line of logs/ID.log is")]
UsedKeys = Annotated[
    Path | None, typer.Option(metavar="DIR", help="buses over TLS; `cpnet keys` makes DIR")
]
Insecure = Annotated[
    bool, typer.Option("--insecure", help="without keys on other networks than loopback")
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
    """Prints all rows at the end; if interrupted, those measured so far."""
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


def junctions_of(tls: list[str] | None) -> str | list[str] | None:
    """Reads `--tls`: "all", or ids with commas between them; given twice, all of them count."""
    found = [one.strip() for text in tls or () for one in text.split(",")]
    return "all" if "all" in found else found or None


def one_signal(tls: list[str] | None) -> str | None:
    """Returns the signal of a `--tls` that takes one.

    Raises:
        ConfigError: several were given.
    """
    if tls and len(tls) > 1:
        raise ConfigError(f"--tls: {', '.join(tls)} were given; this command takes one signal")
    return tls[0] if tls else None
