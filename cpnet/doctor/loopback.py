"""Whether a bus works within this machine."""

from __future__ import annotations

from cpnet.doctor.finding import Finding
from cpnet.endpoints import connecting, resolve
from protocol.bus import open_bus
from protocol.errors import BusError
from protocol.inbox import Inbox
from protocol.topics import BusName

_TIMEOUT_MS = 5_000


def bus() -> list[Finding]:
    """Hosts a bus and connects to it."""
    what = "a Zenoh bus over TCP on loopback"
    endpoint = resolve([], [], set(BusName))[BusName.V2X]
    try:
        router = open_bus(BusName.V2X, endpoint, Inbox())
        try:
            open_bus(BusName.V2X, connecting(endpoint), Inbox(), _TIMEOUT_MS).close()
        finally:
            router.close()
    except BusError as error:
        return [Finding("bus_on_loopback", what, ok=False, advice=str(error))]
    return [Finding("bus_on_loopback", what, ok=True)]
