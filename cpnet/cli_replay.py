"""The command `cpnet replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import Override, assigned, console

replay_app = typer.Typer(pretty_exceptions_enable=False)


@replay_app.command("replay")
def replay_command(
    tape: Annotated[Path, typer.Argument(help="run folder with a tape, or an MCAP file")],
    *,
    speed: Annotated[
        float | None, typer.Option(metavar="N", help="in realtime, N times as fast as recorded")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="each frame waits for its request, as fast as it can")
    ] = False,
    set_: Override = None,
    out: Annotated[Path | None, typer.Option(help="run folder; default runs/NAME-TIME")] = None,
) -> None:
    """Play a recorded run to live processes: another detector, policy or link, the same scans."""
    from cpnet.conclusion import conclude
    from cpnet.replay import Pace, setup_of
    from cpnet.up import Options, up

    played = setup_of(tape, assigned(set_), Pace.of(speed, lockstep=lockstep))
    status, run_dir = up(Options("", {}, None, [], [], out), console, played)
    conclude(run_dir)
    raise typer.Exit(status)
