"""The commands that look after a machine: `cpnet doctor`, `compile`, `prune` and `keys`."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import AsJson, console
from cpnet.run_folder import RUNS, prune
from protocol.access import MAX_VEHICLE_PROCESSES, roles_of
from protocol.errors import ConfigError
from protocol.extras import to_install

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
    from cpnet.findings import findings_as_json, print_findings
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
        typer.echo(json.dumps(findings_as_json(findings), indent=2))
    else:
        print_findings(findings, console)
    raise typer.Exit(0 if all(finding.is_well for finding in findings) else 1)


@doctor_app.command("compile")
def compile_command() -> None:
    """Compile what runs need, once, on all cores; runs do so themselves if it was not done."""
    from cpnet.compiling import compile_ahead

    if not compile_ahead(console):
        console.print("all is compiled")


@doctor_app.command("prune")
def prune_command(
    folder: Annotated[Path, typer.Argument(help="that holds run folders")] = RUNS,
    *,
    keep: Annotated[int, typer.Option(min=0, help="of the newest runs stay in any case")] = 20,
    days: Annotated[
        float | None, typer.Option(min=0, help="others stay until they are so old; else none does")
    ] = None,
) -> None:
    """Remove runs that have ended, all but the newest."""
    removed = prune(folder, keep, days, datetime.now(UTC))
    for run in removed:
        console.print(f"removed {run}", highlight=False, soft_wrap=True)
    if not removed:
        console.print(f"nothing to remove in {folder}", highlight=False, soft_wrap=True)


keys_app = typer.Typer()


@keys_app.command("keys")
def keys_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="new, or made by this command")],
    *,
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME|IP", help="what others call the machines of router and sim"),
    ] = None,
    vehicles: Annotated[
        int, typer.Option(min=0, max=MAX_VEHICLE_PROCESSES, help="vehicle processes")
    ] = 2,
    regions: Annotated[
        list[str] | None, typer.Option("--region", metavar="ID", help="regions of the scenario: r0")
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="how long they hold")] = 365,
    router_config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="for zenohd as host of the V2X bus: its settings"),
    ] = None,
) -> None:
    """Make a test authority and certificates for `cpnet up --keys`, or those that DIR lacks."""
    try:
        from cpnet.keys import add_keys
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"making keys needs {error.name} (extra `keys`): {to_install('keys')}"
        ) from None
    from cpnet.keys import write_router_config

    ids = list(roles_of(vehicles, regions or ["r0"]))
    made = add_keys(folder, ids, host or [], days)
    console.print(f"{folder}: made {', '.join(made) or 'nothing, all is there'}", soft_wrap=True)
    console.print(
        "Each machine gets ca.pem, watch.pem, watch.key and the .pem and .key of the processes it "
        "runs (relay-* where links are emulated), nothing else, but view.pem and view.key where "
        "an observer attaches or records; ca.key stays here.",
        soft_wrap=True,
    )
    if router_config is not None:
        write_router_config(router_config, folder)
        console.print(f"wrote {router_config}", highlight=False, soft_wrap=True)
