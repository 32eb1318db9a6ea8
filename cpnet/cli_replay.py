"""The command `cpnet replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import (
    Connect,
    Insecure,
    Listen,
    Log,
    Only,
    Out,
    Override,
    ServeMetrics,
    UsedKeys,
    View,
    assigned,
    console,
)
from protocol.errors import ConfigError
from protocol.logs import LogStyle

replay_app = typer.Typer(pretty_exceptions_enable=False)
_SCANS = "Scans from elsewhere"


@replay_app.command("replay")
def replay_command(  # noqa: PLR0913 - one parameter per option of the command
    tape: Annotated[
        Path | None, typer.Argument(help="run folder with a tape, or an MCAP file")
    ] = None,
    *,
    speed: Annotated[
        float | None, typer.Option(metavar="N", help="in realtime, N times as fast as recorded")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="each frame waits for its request, as fast as it can")
    ] = False,
    set_: Override = None,
    out: Out = None,
    only: Only = None,
    listen: Listen = None,
    connect: Connect = None,
    metrics: ServeMetrics = None,
    view: View = None,
    log: Log = LogStyle.TEXT,
    keys: UsedKeys = None,
    insecure: Insecure = False,
    scans: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="folder of .bin or .pcd", rich_help_panel=_SCANS),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="CSV, KITTI's or EMP's text", rich_help_panel=_SCANS),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="how sensors are mounted", rich_help_panel=_SCANS),
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="numbered devices' names", rich_help_panel=_SCANS),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine", help="extrinsics are a guess", rich_help_panel=_SCANS)
    ] = False,
    scenario: Annotated[
        str | None,
        typer.Option(help="whose roads are those of the scans", rich_help_panel=_SCANS),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="how many; files are played anew", rich_help_panel=_SCANS),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(metavar="M", help="over the ground; else found", rich_help_panel=_SCANS),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(min=1, help="of the open ground, m; else 60", rich_help_panel=_SCANS),
    ] = None,
) -> None:
    """Play a recorded run to live processes: another detector, policy or link, the same scans."""
    from cpnet.conclusion import conclude
    from cpnet.preparation import Options
    from cpnet.replay import Pace, played_tape
    from cpnet.up import up

    pace, overrides = Pace.of(speed, lockstep=lockstep), assigned(set_)
    if (tape is None) == (scans is None):
        both = "" if tape is None else "; not both"
        raise ConfigError(f"give the tape that is to be played, or --scans DIR --poses FILE{both}")
    if tape is not None:
        named = [poses, extrinsics, sensors, scenario, frames, height, width]
        if refine or any(option is not None for option in named):
            raise ConfigError("--poses and all that is for scans from elsewhere needs --scans DIR")
        played = played_tape(tape, overrides, pace, console)
    elif refine and extrinsics is None:
        raise ConfigError(
            "--refine needs --extrinsics FILE: a first guess of how sensors are mounted"
        )
    elif scans is None or poses is None:
        raise ConfigError("--scans needs --poses FILE: where the sensor was in each frame")
    else:
        from cpnet.replay_scans import Scans, played_scans
        from player.scans.agents import Source

        names = [name.strip() for name in sensors.split(",")] if sensors else []
        source = Source(scans, poses, extrinsics, names, refine=refine)
        played = played_scans(
            Scans(source, scenario, overrides, frames, height, width), pace, console
        )
    options = Options(
        "", {}, only, listen or [], connect or [], out,
        metrics=metrics, log=log, keys=keys, insecure=insecure, view=view,
    )  # fmt: skip
    status, run_dir = up(options, console, played)
    conclude(run_dir)
    raise typer.Exit(status)
