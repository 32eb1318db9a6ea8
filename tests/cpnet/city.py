"""Hosts that are network namespaces, joined by two switches: the world's, and the V2X network."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from itertools import count

from tests.kernel_links import FRAME_BYTES, KernelError, call

_numbers = count()


@dataclass(frozen=True, slots=True)
class Host:
    """A namespace with an address in either network."""

    namespace: str
    world: str
    v2x: str


class City:
    """Makes hosts; a context manager that removes them."""

    def __init__(self) -> None:
        self._name = f"city{os.getpid()}-{next(_numbers)}"
        self._namespaces: list[str] = []
        self._uplinks: list[str] = []
        self._net = f"10.{64 + os.getpid() % 128}"
        self.switch = self._add("switch")
        for bridge in ("world", "v2x"):
            self._in(self.switch, f"link add {bridge} type bridge", f"link set {bridge} up")

    def __enter__(self) -> City:
        return self

    def __exit__(self, *_: object) -> None:
        for namespace in self._namespaces:
            with suppress(KernelError):
                call("ip", "netns", "del", namespace)

    def host(self, name: str, uplink: str = "") -> Host:
        """Adds a host; `uplink` limits what it sends into the V2X network, such as `5mbit`."""
        namespace, number = self._add(name), len(self._namespaces)
        self._in(namespace, "link set lo up")
        addresses = []
        for third, bridge in enumerate(("world", "v2x"), start=1):
            address, port = f"{self._net}.{third}.{number}", f"{bridge[0]}{number}"
            ends = f"{port} type veth peer name {bridge} netns {namespace}"
            self._in(self.switch, f"link add {ends}", f"link set {port} master {bridge} up")
            self._in(namespace, f"address add {address}/24 dev {bridge}", f"link set {bridge} up")
            addresses.append(address)
        if uplink:
            limit = f"qdisc add dev v2x root tbf rate {uplink} burst {2 * FRAME_BYTES} limit 4mb"
            call("tc", "-netns", namespace, *limit.split())
        return Host(namespace, *addresses)

    def _add(self, name: str) -> str:
        namespace = f"{self._name}-{name}"
        call("ip", "netns", "add", namespace)
        self._namespaces.append(namespace)
        return namespace

    def _in(self, namespace: str, *lines: str) -> None:
        call("ip", "-netns", namespace, lines=lines)
