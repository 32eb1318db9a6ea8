"""The process table: roles, their modules, and the order in which they start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from protocol.errors import ConfigError
from protocol.instances import (
    REGION_ROLES,
    ROUTER,
    WORLD_HOST,
    instances_of,
    parse_id,
    role_of,
)
from protocol.topics import BusName

if TYPE_CHECKING:
    from cpnet.scenario import Scenario


@dataclass(frozen=True, slots=True)
class RoleEntry:
    """One row: `hosts` is the bus whose router runs in this role's process."""

    role: str
    module: str
    hosts: BusName | None = None


MCAP = RoleEntry("mcap", "recording.mcap")
ROLES = (
    RoleEntry(ROUTER, "v2x_router", BusName.V2X),
    RoleEntry(WORLD_HOST, "sim_host", BusName.WORLD),
    RoleEntry("record", "recording"),
    MCAP,
    RoleEntry("edge", "edge_server"),
    RoleEntry("signal", "signal_controller"),
    RoleEntry("infra", "infra_agent"),
    RoleEntry("vehicle", "vehicle_agent"),
)
"""In starting order: the hosts of the buses first."""

RELAY = RoleEntry("relay", "link_relay")
PLAYER = "recording.playback"
"""The module that runs, in a replay, the roles whose messages are in the recording."""
_RECORDED = {"sim", "vehicle", "infra"}
AGENTS = {"vehicle": "vehicle", "infra": "roadside"}
"""Roles whose connections a relay may shape, with the names of their links."""


ProcessKey = tuple[str, str]
"""Role and id of a process."""


@dataclass(frozen=True, slots=True)
class ProcessEntry:
    """One process to start."""

    id: str
    role: RoleEntry


@dataclass(frozen=True, slots=True)
class RoleSelection:
    """Selection of what runs on this machine: roles, some of them with certain processes only."""

    roles: tuple[RoleEntry, ...]
    ids: frozenset[str] = frozenset()

    @property
    def names(self) -> list[str]:
        """The roles' names, in starting order."""
        return [row.role for row in self.roles]

    def __str__(self) -> str:
        """The roles, and in their place the processes that were named."""
        return "-".join(
            name for row in self.roles for name in sorted(self._of(row.role)) or [row.role]
        )

    def _of(self, role: str) -> list[str]:
        return [name for name in self.ids if role_of(name) == role]

    def chosen(self, row: RoleEntry, planned: list[str]) -> list[str]:
        """Returns the processes of a role that run here, of those that a scenario starts with."""
        named = self._of(row.role)
        beyond = sorted(set(named) - set(planned), key=lambda name: (len(name), name))
        return [name for name in planned if name in named] + beyond if named else planned


def processes_without_scenario(choice: RoleSelection) -> list[ProcessEntry]:
    """Returns the processes that run here whatever the scenario is: several only if named."""
    several = {*REGION_ROLES, *AGENTS}
    return [
        ProcessEntry(name, row)
        for row in choice.roles
        if row is not MCAP
        for name in choice.chosen(row, [] if row.role in several else [row.role])
    ]


def parse_only(only: str | None) -> RoleSelection:
    """Reads `--only ROLE,...` and `--only edge-r0,vehicle-1,...`; all roles without it.

    Raises:
        ConfigError: there is no such role.
    """
    names = [row.role for row in ROLES]
    wanted = [name.strip() for name in only.split(",")] if only else names
    ids = {name for name in wanted if name not in names and parse_id(name)}
    roles = {role_of(name) if name in ids else name for name in wanted}
    for name in sorted(roles - set(names)):
        raise ConfigError(
            f"--only: there is no role {name!r}; allowed: {', '.join(names)}, and single "
            "processes such as edge-r0 or vehicle-1"
        )
    whole = roles.intersection(wanted)
    kept = frozenset(name for name in ids if role_of(name) not in whole)
    return RoleSelection(tuple(row for row in ROLES if row.role in roles), kept)


def in_replay(row: RoleEntry) -> RoleEntry:
    """Returns the row for a replay: the playback publishes recorded messages."""
    return replace(row, module=PLAYER) if row.role in _RECORDED else row


def relays_of(choice: RoleSelection, scenario: Scenario) -> list[ProcessEntry]:
    """Returns the relays that the agents of this machine need on it."""
    link = scenario.link
    if link.channel(scenario.mode) != "emulated":
        return []
    profiles = {"vehicle": link.profile, "roadside": link.roadside_profile}
    kinds = [AGENTS[name] for name in choice.names if name in AGENTS]
    return [ProcessEntry(f"relay-{kind}", RELAY) for kind in kinds if profiles[kind] is not None]


def processes_of(choice: RoleSelection, scenario: Scenario) -> list[ProcessEntry]:
    """Returns the processes of this machine in this scenario, in starting order.

    Vehicle processes beyond the scenario's join it; the mcap role needs `record.mcap`.

    Raises:
        ConfigError: a process was named that the scenario has no place for.
    """
    planned = instances_of(scenario.model_dump(mode="json"))
    result = []
    for row in choice.roles:
        if row is MCAP and not scenario.record.mcap:
            if choice.roles != ROLES:
                raise ConfigError("--only mcap: the scenario has record.mcap false; see --record")
            continue
        own = [one.id for one in planned if one.role == row.role]
        for name in choice.chosen(row, own):
            if row.role in REGION_ROLES and name not in own:
                raise ConfigError(
                    f"--only {name}: the scenario has no such process; of {row.role} it has "
                    f"{', '.join(own) or 'none'}"
                )
            result.append(ProcessEntry(name, row if scenario.replay is None else in_replay(row)))
    return result
