"""The command `cpnet keys`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cpnet.cli_options import console
from protocol.access import MOST_VEHICLES, roles_of
from protocol.errors import ConfigError

keys_app = typer.Typer()


@keys_app.command("keys")
def keys_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="new, or made by this command")],
    *,
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME|IP", help="what others call the machines of edge and sim"),
    ] = None,
    vehicles: Annotated[int, typer.Option(min=0, max=MOST_VEHICLES, help="vehicle processes")] = 2,
    posts: Annotated[int, typer.Option(min=0, max=1000, help="roadside processes")] = 1,
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
            f"making keys needs {error.name} (extra `keys`): "
            f"{sys.executable} -m pip install 'cpnet-edge[keys]'"
        ) from None
    from cpnet.router_config import ROUTER, write_router_config

    ids = [*roles_of(vehicles, posts), *([ROUTER] if router_config else [])]
    made = add_keys(folder, ids, host or [], days)
    console.print(f"{folder}: made {', '.join(made) or 'nothing, all is there'}", soft_wrap=True)
    console.print(
        "Each machine gets ca.pem, watch.pem, watch.key and the .pem and .key of the processes it "
        "runs (relay-* where links are emulated), nothing else, but view.pem and view.key where "
        "somebody looks on or records; ca.key stays here.",
        soft_wrap=True,
    )
    if router_config is not None:
        write_router_config(router_config, folder)
        console.print(f"wrote {router_config}", highlight=False, soft_wrap=True)
