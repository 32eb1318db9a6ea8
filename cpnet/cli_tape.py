"""Commands that record a run from outside and convert a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import console

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
    no_foxglove: Annotated[
        bool, typer.Option("--no-foxglove", help="the messages alone, nothing for other tools")
    ] = False,
) -> None:
    """Keep all that a running system says in an MCAP file, until its end or Ctrl-C."""
    from cpnet.discovery import find_run
    from cpnet.recording_command import record_run
    from recording.mcap.recorder import RecordedContent

    choice = RecordedContent(truth=not no_truth, foxglove=not no_foxglove)
    record_run(find_run(run, connect or [], keys), choice, out, duration, console)


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
    from cpnet.recording_command import convert_recording

    convert_recording(recording, out, cloud_every, console)
