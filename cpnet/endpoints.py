"""Where the two buses are: from `--listen` and `--connect`, or free ports on loopback."""

from __future__ import annotations

import re
import socket

from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.topics import BusName

_LOCATOR = re.compile(
    r"(?:(?P<bus>v2x|world)=)?(?:tcp/)?(?P<host>\[[^\]]+\]|[^:=/\s]+):(?P<port>\d+)"
)
Endpoints = dict[BusName, Endpoint]


def resolve(listen: list[str], connect: list[str], hosted: set[BusName]) -> Endpoints:
    """Returns how this machine reaches each bus; `hosted` are those whose router runs here.

    `HOST:PORT` means the V2X bus at PORT and the world bus at PORT + 1; `v2x=HOST:PORT` and
    `world=HOST:PORT` name one of them.

    Raises:
        ConfigError: a locator cannot be read, a bus has no place, or a port is in use.
    """
    listens, connects = _read("--listen", listen), _read("--connect", connect)
    result = {}
    for bus in BusName:
        if bus in hosted:
            locator = listens.get(bus) or free_locator()
            _check_free(locator)
            result[bus] = Endpoint(locator, listen=True)
        elif bus in connects:
            result[bus] = Endpoint(connects[bus], listen=False)
        else:
            role = "edge" if bus is BusName.V2X else "sim"
            raise ConfigError(
                f"the {bus.value} bus lives where the role {role} runs, and that is not here: "
                f"say where with --connect {bus.value}=HOST:PORT"
            )
    return result


def connecting(endpoint: Endpoint) -> Endpoint:
    """Returns how another process of this machine reaches the same bus."""
    locator = endpoint.locator.replace("tcp/0.0.0.0:", "tcp/127.0.0.1:")
    return Endpoint(locator.replace("tcp/[::]:", "tcp/[::1]:"), listen=False)


def _read(option: str, texts: list[str]) -> dict[BusName, str]:
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
                result[bus] = f"tcp/{match['host']}:{port}"
    return result


def free_locator() -> str:
    """Returns a place on loopback that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _check_free(locator: str) -> None:
    host, _, port = locator.removeprefix("tcp/").rpartition(":")
    address = host.strip("[]")
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, int(port)))
        except OSError as error:
            raise ConfigError(
                f"cannot listen at {address} port {port}: {error.strerror or error}; "
                "choose another with --listen HOST:PORT"
            ) from None
