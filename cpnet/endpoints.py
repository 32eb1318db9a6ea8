"""Endpoints of the two buses: from `--listen` and `--connect`, or free ports on loopback."""

from __future__ import annotations

import re
import socket
from dataclasses import replace

from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.instances import ROUTER, WORLD_HOST
from protocol.topics import BusName

_LOCATOR = re.compile(
    r"(?:(?P<bus>v2x|world)=)?(?:tcp/)?(?P<host>\[[^\]]+\]|[^:=/\s]+):(?P<port>\d+)"
)
Endpoints = dict[BusName, Endpoint]


def resolve(
    listen: list[str], connect: list[str], hosted: set[BusName], protocol: str = "tcp"
) -> Endpoints:
    """Returns how this machine reaches each bus; `hosted` are those whose router runs here.

    `HOST:PORT` means the V2X bus at PORT and the world bus at PORT + 1; `v2x=HOST:PORT` and
    `world=HOST:PORT` name one of them. A bus whose router would run here may be on a Zenoh router
    elsewhere instead: then `--connect` names its address.

    Raises:
        ConfigError: a locator cannot be read, a bus has no place, or a port is in use.
    """
    listens = places("--listen", listen, protocol)
    connects = places("--connect", connect, protocol)
    result = {}
    for bus in BusName:
        if bus in connects and not (bus in hosted and bus in listens):
            result[bus] = Endpoint(connects[bus], listen=False)
        elif bus in hosted:
            locator = listens.get(bus) or free_locator(protocol)
            _check_free(locator)
            result[bus] = Endpoint(locator, listen=True)
        else:
            role = ROUTER if bus is BusName.V2X else WORLD_HOST
            raise ConfigError(
                f"the {bus.value} bus lives where the role {role} runs, and that is not here: "
                f"say where with --connect {bus.value}=HOST:PORT"
            )
    return result


def connecting(endpoint: Endpoint) -> Endpoint:
    """Returns the endpoint by which another process of this machine connects to the same bus."""
    locator = endpoint.locator.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
    return replace(endpoint, locator=locator, listen=False)


def places(option: str, texts: list[str], protocol: str = "tcp") -> dict[BusName, str]:
    """Returns the locators of the buses that an option names.

    Raises:
        ConfigError: a text names none.
    """
    result = {}
    for text in texts:
        match = _LOCATOR.fullmatch(text)
        if match is None or not 1 <= int(match["port"]) <= 65534:
            raise ConfigError(
                f"{option} {text!r}: needs HOST:PORT, v2x=HOST:PORT or world=HOST:PORT, "
                "with a port from 1 to 65534"
            )
        for offset, bus in enumerate((BusName.V2X, BusName.WORLD)):
            if match["bus"] in (None, bus.value):
                port = int(match["port"]) + (offset if match["bus"] is None else 0)
                result[bus] = f"{protocol}/{match['host']}:{port}"
    return result


def implies_world(texts: list[str]) -> bool:
    """Whether the world bus is implied to be one port above the named one."""
    matches = [match for text in texts if (match := _LOCATOR.fullmatch(text))]
    buses = [match["bus"] for match in matches if match["bus"] != BusName.V2X.value]
    return bool(buses) and buses[-1] is None


def free_locator(protocol: str = "tcp") -> str:
    """Returns a locator on loopback with a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def address_of(locator: str) -> tuple[str, int]:
    """Returns host and port of a locator."""
    host, _, port = locator.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def _check_free(locator: str) -> None:
    address, port = address_of(locator)
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise ConfigError(
                f"cannot listen at {address} port {port}: {error.strerror or error}; "
                "choose another with --listen HOST:PORT"
            ) from None
