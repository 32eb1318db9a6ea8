"""Whether a TCP port answers, and what it means if it does not."""

from __future__ import annotations

import socket
import time

from cpnet.doctor.finding import Finding
from cpnet.endpoints import address_of
from protocol.topics import BusName

TCP_S = 1.5
HOSTS = {BusName.V2X: "edge", BusName.WORLD: "sim"}


def reach(bus: BusName, locator: str) -> Finding:
    """Connects and hangs up."""
    host, port = address_of(locator)
    what, check = f"the {bus.value} bus at {host}:{port}", f"{bus.value}_reached"
    began_ns = time.monotonic_ns()
    try:
        socket.create_connection((host, port), TCP_S).close()
    except (OSError, UnicodeError) as error:
        return Finding(check, what, ok=False, advice=_advise(bus, error))
    took_ms = (time.monotonic_ns() - began_ns) / 1e6
    told = f"{what} answers within {took_ms:.1f} ms"
    return Finding(check, told, ok=True, measured={"connect_ms": round(took_ms, 3)})


def _advise(bus: BusName, error: OSError | UnicodeError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return (
            "the machine is there, but nobody listens at this port: is the role "
            f"{HOSTS[bus]} running there, with --listen, and on this port?"
        )
    if isinstance(error, TimeoutError):
        return "no answer: is the machine on, and does a firewall let this TCP port through?"
    if isinstance(error, socket.gaierror | UnicodeError):
        return "there is no such host: check its name, or give its address"
    return f"{error.strerror or error}: check the address and the way to it"
