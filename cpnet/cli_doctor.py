"""The command that looks at a machine before a run does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import AsJson, console

doctor_app = typer.Typer()


@doctor_app.command("doctor")
def doctor_command(
    *,
    packages: Annotated[
        bool, typer.Option("--packages", help="print the missing system packages only")
    ] = False,
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="PLACE", help="ask the buses of another machine too, named as for up"),
    ] = None,
    keys: Annotated[
        Path | None, typer.Option(metavar="DIR", help="look at these certificates, ask with them")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check this machine: libraries, SUMO, bus, socket buffers; certificates; buses elsewhere."""
    from cpnet import doctor
    from cpnet.endpoints import implies_world, places
    from cpnet.security import WATCH
    from protocol.access import Keys
    from protocol.bus import Endpoint

    if packages:
        typer.echo(" ".join(doctor.missing_packages()))
        return
    own = Keys.of(keys, WATCH) if keys else None
    named = places("--connect", connect or [], "tls" if keys else "tcp")
    elsewhere = {bus: Endpoint(at, listen=False, keys=own) for bus, at in named.items()}
    findings = doctor.examine()
    if keys is not None:
        findings += doctor.examine_keys(keys)
    findings += doctor.examine_buses(elsewhere, implied=implies_world(connect or []))
    if as_json:
        typer.echo(json.dumps(doctor.as_json(findings), indent=2))
    else:
        doctor.print_findings(findings, console)
    raise typer.Exit(0 if all(finding.is_well for finding in findings) else 1)
