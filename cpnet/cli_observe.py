"""Commands that observe a running system: view, top, record; and convert a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import console, one_signal
from protocol.errors import ConfigError

view_app = typer.Typer()
FPS = 2.0  # where --fps is not given

Run = Annotated[Path | None, typer.Argument(help="run folder; default the newest run in runs/")]
Connect = Annotated[
    list[str] | None, typer.Option(metavar="PLACE", help="a run elsewhere, named as for up")
]
KeysFolder = Annotated[
    Path | None, typer.Option(metavar="DIR", help="certificates, if not those of the run")
]

OneSignal = Annotated[
    list[str] | None, typer.Option("--tls", metavar="ID", help="show this signal's junction alone")
]


@view_app.command("view")
def view_command(
    run: Run = None,
    *,
    connect: Connect = None,
    keys: KeysFolder = None,
    tls: OneSignal = None,
    web: Annotated[bool, typer.Option("--web", help="in a browser; prints where")] = False,
    port: Annotated[int, typer.Option(min=1, max=65534, help="of the page, with --web")] = 9090,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="write it to a file, show nothing")
    ] = None,
    fps: Annotated[float, typer.Option(min=0.1, max=60, help="frames a second, at most")] = FPS,
) -> None:
    """Show a running system in Rerun: clouds, boxes, signal, counts, plots."""
    from cpnet.observe import Screen, view

    if save is not None and web:
        raise ConfigError("--save writes a file, --web serves a page: give one of them")
    view(
        run, connect or [], keys, one_signal(tls), Screen(port if web else None, save, fps), console
    )


@view_app.command("top")
def top_command(
    run: Run = None,
    *,
    connect: Connect = None,
    keys: KeysFolder = None,
    tls: OneSignal = None,
    once: Annotated[bool, typer.Option("--once", help="print one picture and end")] = False,
) -> None:
    """Show a running system in the terminal: agents, latency, counts, phases, alerts.

    Of several signals it shows an overview of them and of the regions.
    """
    from cpnet.observe import top

    top(run, connect or [], keys, one_signal(tls), console, once=once)


recording_app = typer.Typer()


@recording_app.command("record")
def record_command(
    run: Annotated[
        Path | None, typer.Argument(help="folder of a run that goes on; default the newest")
    ] = None,
    *,
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="PLACE", help="a run elsewhere: HOST:PORT, v2x=…, world=…"),
    ] = None,
    keys: Annotated[
        Path | None, typer.Option(metavar="DIR", help="listen with the certificate of view")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="default RUN/record.mcap, or here")
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.1, help="s; default to the end")] = None,
    no_truth: Annotated[
        bool, typer.Option("--no-truth", help="leave out where vehicles truly were")
    ] = False,
) -> None:
    """Record all messages of a running system in an MCAP file, until its end or Ctrl-C."""
    from cpnet.discovery import find_run
    from cpnet.observe import record_run

    record_run(find_run(run, connect or [], keys), out, duration, console, truth=not no_truth)


@recording_app.command("foxglove")
def foxglove_command(
    recording: Annotated[Path, typer.Argument(help="run folder, or a file of `cpnet record`")],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="default RUN/foxglove.mcap")
    ] = None,
    cloud_every: Annotated[
        int, typer.Option(metavar="N", min=1, help="clouds of each N-th frame: they are large")
    ] = 5,
) -> None:
    """Write a recording's boxes, poses and clouds for Foxglove and other tools, of all frames."""
    from cpnet.observe import convert_recording

    convert_recording(recording, out, cloud_every, console)
