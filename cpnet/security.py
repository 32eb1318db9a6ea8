"""How the buses of a run are protected: by TLS with `--keys`, or by staying on loopback."""

from __future__ import annotations

import ipaddress
from dataclasses import replace
from pathlib import Path

from cpnet.endpoints import Endpoints, address_of, resolve
from cpnet.processes import ProcessEntry
from protocol.access import Keys
from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.topics import BusName

WATCH = "watch"
"""The id of the supervisor of each machine."""
VIEW = "view"
"""The id of whoever looks on and hears all."""


def secured(
    listen: list[str], connect: list[str], hosted: set[BusName], keys: Path | None, insecure: bool
) -> Endpoints:
    """Returns how this machine reaches each bus, with the supervisor's own keys if there are any.

    Raises:
        ConfigError: as `resolve`; the keys cannot be used; or without keys, a bus would leave this
            machine.
    """
    if keys is None:
        places = resolve(listen, connect, hosted)
        for endpoint in places.values():
            if not (insecure or _is_on_loopback(endpoint)):
                raise ConfigError(_refusal(endpoint))
        return places
    if insecure:
        raise ConfigError("--insecure: has no meaning with --keys; give one of them")
    from cpnet.key_check import check_key  # the library of TLS takes its time to load

    check_key(keys, WATCH)
    own = Keys.of(keys, WATCH)
    places = resolve(listen, connect, hosted, "tls")
    return {bus: replace(endpoint, keys=own) for bus, endpoint in places.items()}


def check_keys(keys: Path | None, entries: list[ProcessEntry]) -> None:
    """Looks through the certificates of the processes that are to start here.

    Raises:
        ConfigError: one is missing or cannot be used.
    """
    if keys is None:
        return
    from cpnet.key_check import check_key

    for entry in entries:
        check_key(keys, entry.id, hosts=entry.role.hosts is not None)


def _is_on_loopback(endpoint: Endpoint) -> bool:
    host, _ = address_of(endpoint.locator)
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _refusal(endpoint: Endpoint) -> str:
    option = "--listen" if endpoint.listen else "--connect"
    return (
        f"{option} {endpoint.locator}: without keys anybody on that network could read and forge "
        "what is said; give --keys DIR (`cpnet keys DIR` makes them), or --insecure to do without"
    )
