"""Process instances: which processes a run has, with their ids and roles.

Nothing else makes or reads the id of a process: readiness, supervisor, access control,
certificates, the edge, recordings and runs in one process ask here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

AGENT_ROLES = ("infra", "vehicle")
"""Roles of which a run has any number of processes, with the agents of one kind each."""

_SINGLE_ROLES = ("sim", "record", "edge", "signal")
_AGENT_ID = re.compile(r"(infra|vehicle)-(0|[1-9]\d{0,3})")


@dataclass(frozen=True, slots=True)
class Instance:
    """A process: its id, which stands in keys and names its certificate, and its role."""

    id: str
    role: str


def instances_of(scenario: Mapping[str, Any]) -> list[Instance]:
    """Returns the processes that a run of a scenario begins with, the world's own first."""
    numbers = {
        "infra": len(scenario["roadside_mounts"]),
        "vehicle": scenario["processes"]["vehicle"],
    }
    mcap = ["mcap"] if scenario.get("record", {}).get("mcap") else []
    found = [Instance(role, role) for role in (*_SINGLE_ROLES, *mcap)]
    return found + [one for role, count in numbers.items() for one in agent_instances(role, count)]


def agent_instances(role: str, count: int) -> list[Instance]:
    """Returns the first `count` processes of a role of agents."""
    return [Instance(f"{role}-{number}", role) for number in range(count)]


def agent_number(process_id: str) -> tuple[str, int]:
    """Returns role and number of a process of agents; any other id has no role and -1."""
    match = _AGENT_ID.fullmatch(process_id)
    return ("", -1) if match is None else (match[1], int(match[2]))


def role_of(process_id: str) -> str:
    """Returns the role that an id says."""
    return process_id.partition("-")[0]
