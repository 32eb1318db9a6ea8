"""The process table: which roles there are, what runs them, in which order they start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from protocol.errors import ConfigError
from protocol.topics import BusName

if TYPE_CHECKING:
    from cpnet.scenario import Scenario


@dataclass(frozen=True, slots=True)
class RoleEntry:
    """One row: `hosts` is the bus whose router lives in this role's process."""

    role: str
    module: str
    hosts: BusName | None = None


ROLES = (
    RoleEntry("edge", "edge_server", BusName.V2X),
    RoleEntry("sim", "sim_host", BusName.WORLD),
    RoleEntry("record", "recorder"),
    RoleEntry("signal", "signal_controller"),
    RoleEntry("infra", "infra_agent"),
    RoleEntry("vehicle", "vehicle_agent"),
)
"""In starting order: the hosts of the buses first."""

RELAY = RoleEntry("relay", "link_relay")
AGENTS = {"vehicle": "vehicle", "infra": "roadside"}
"""Roles whose connections a relay may shape, and what their links are called."""


@dataclass(frozen=True, slots=True)
class ProcessEntry:
    """One process to start."""

    id: str
    role: RoleEntry


def choose_roles(only: str | None) -> list[RoleEntry]:
    """Reads `--only ROLE,...`; all roles without it.

    Raises:
        ConfigError: there is no such role.
    """
    names = [row.role for row in ROLES]
    wanted = [name.strip() for name in only.split(",")] if only else names
    for name in wanted:
        if name not in names:
            raise ConfigError(f"--only: there is no role {name!r}; allowed: {', '.join(names)}")
    return [row for row in ROLES if row.role in wanted]


def relays_of(roles: list[RoleEntry], scenario: Scenario) -> list[ProcessEntry]:
    """Returns the relays that agents of these roles need on their machine."""
    link = scenario.link
    if link.way(scenario.mode) != "emulated":
        return []
    profiles = {"vehicle": link.profile, "roadside": link.roadside_profile}
    kinds = [AGENTS[row.role] for row in roles if row.role in AGENTS]
    return [ProcessEntry(f"relay-{kind}", RELAY) for kind in kinds if profiles[kind] is not None]


def processes_of(roles: list[RoleEntry], scenario: Scenario) -> list[ProcessEntry]:
    """Returns the processes that these roles need in this scenario, in starting order."""
    numbers = {"vehicle": scenario.processes.vehicle, "infra": len(scenario.roadside_mounts)}
    result = []
    for row in roles:
        if row.role in numbers:
            result += [ProcessEntry(f"{row.role}-{i}", row) for i in range(numbers[row.role])]
        else:
            result.append(ProcessEntry(row.role, row))
    return result
