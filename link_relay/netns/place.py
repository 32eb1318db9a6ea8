"""What the namespaces and devices of agents are called, and their addresses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

UPLINK = "uplink"  # the agent's device, inside its namespace
_NAMESPACE = re.compile(r"cpnet-(\d+)-(\d+)")
_DEVICE = re.compile(r"cp(\d+)-(\d+)")
_MOST = 100_000  # a device's name has 15 characters at most, a process id up to 7
_RANGE = 198 << 24 | 19 << 16  # the half of RFC 2544's range for tests that proxies leave alone
_PAIRS = 1 << 15


@dataclass(frozen=True, slots=True)
class Place:
    """An agent's namespace: names that carry the process that makes it, so that none collide."""

    pid: int
    number: int

    @property
    def namespace(self) -> str:
        """Name of the network namespace."""
        return f"cpnet-{self.pid}-{self.number % _MOST}"

    @property
    def device(self) -> str:
        """Name of the veth's end on the host."""
        return f"cp{self.pid}-{self.number % _MOST}"

    @classmethod
    def of(cls, name: str) -> Self | None:
        """Returns whose namespace or device this name is, None if it is not one of cpnet's."""
        match = _NAMESPACE.fullmatch(name) or _DEVICE.fullmatch(name)
        return cls(int(match[1]), int(match[2])) if match else None


@dataclass(frozen=True, slots=True)
class Pair:
    """The two addresses of a veth pair, a network of their own."""

    host: str
    agent: str

    @classmethod
    def of(cls, device_index: int) -> Self:
        """Returns the pair of a device of the host; its index is unique there, so is the pair."""
        first = _RANGE + 2 * (device_index % _PAIRS)
        return cls(_dotted(first), _dotted(first + 1))


def _dotted(address: int) -> str:
    return ".".join(str(address >> shift & 255) for shift in (24, 16, 8, 0))
