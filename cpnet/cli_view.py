"""Commands that look on at a running system."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import console
from cpnet.looking import FPS
from protocol.errors import ConfigError

view_app = typer.Typer()

Run = Annotated[Path | None, typer.Argument(help="run folder; default the newest run in runs/")]
Connect = Annotated[
    list[str] | None, typer.Option(metavar="PLACE", help="a run elsewhere, named as for up")
]
KeysFolder = Annotated[
    Path | None, typer.Option(metavar="DIR", help="certificates, if not those of the run")
]


@view_app.command("view")
def view_command(
    run: Run = None,
    *,
    connect: Connect = None,
    keys: KeysFolder = None,
    web: Annotated[bool, typer.Option("--web", help="in a browser; prints where")] = False,
    port: Annotated[int, typer.Option(min=1, max=65534, help="of the page, with --web")] = 9090,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="write it to a file, show nothing")
    ] = None,
    fps: Annotated[float, typer.Option(min=0.1, max=60, help="frames a second, at most")] = FPS,
) -> None:
    """Show a running system in Rerun: clouds, boxes, signal, counts, plots."""
    from cpnet.viewing import Screen, view

    if save is not None and web:
        raise ConfigError("--save writes a file, --web serves a page: give one of them")
    view(run, connect or [], keys, Screen(port if web else None, save, fps), console)


@view_app.command("top")
def top_command(
    run: Run = None,
    *,
    connect: Connect = None,
    keys: KeysFolder = None,
    once: Annotated[bool, typer.Option("--once", help="print one picture and end")] = False,
) -> None:
    """Show a running system in the terminal: agents, latency, counts, phases, alerts."""
    from cpnet.viewing import top

    top(run, connect or [], keys, console, once=once)
