"""The configuration of a Zenoh router that is not ours, as host of the V2X bus."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from protocol.access import AUTHORITY, Keys, Members, access_control
from protocol.bus import settings_of
from protocol.errors import ConfigError
from protocol.manners import dropping
from protocol.topics import ROLES, BusName

ROUTER = "router"
"""The id of that router's certificate."""

LISTEN = "tls/[::]:7447"
_HEAD = """\
// For zenohd as host of the V2X bus, with the rules of cpnet for the certificates in
// {folder}.
// Paths are those of the machine where `cpnet keys` was run.
"""


def members_in(folder: Path) -> Members:
    """Returns the role of each process that has a certificate in a folder, by its id."""
    names = [path.stem for path in sorted(folder.glob("*.pem")) if path.name != AUTHORITY]
    return Members({name: role for name in names if (role := name.partition("-")[0]) in ROLES})


def router_config(folder: Path) -> dict[str, Any]:
    """Returns the settings; where it listens may be changed, the other ones hold the rules."""
    config: dict[str, Any] = {"mode": "router", "listen": {"endpoints": [LISTEN]}}
    for path, value in settings_of(Keys.of(folder, ROUTER)).items():
        *parents, last = path.split("/")
        inner = config
        for name in parents:
            inner = inner.setdefault(name, {})
        inner[last] = value
    config["qos"] = {"network": dropping()}
    config["access_control"] = access_control(BusName.V2X, members_in(folder))
    return config


def write_router_config(path: Path, folder: Path) -> None:
    """Writes the file that `zenohd --config` takes.

    Raises:
        ConfigError: it cannot be written.
    """
    folder = folder.resolve()
    text = _HEAD.format(folder=folder) + json.dumps(router_config(folder), indent=2) + "\n"
    try:
        path.write_text(text, "utf-8")
    except (OSError, ValueError) as error:
        raise ConfigError(f"--router-config {path}: {error}") from None
