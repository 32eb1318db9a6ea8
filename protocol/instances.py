"""Process instances: which processes a run has, with their ids, roles and regions.

No other module makes or parses the id of a process: readiness, supervisor, access control,
certificates, the edge, recordings and runs in one process use this one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

ROUTER = "router"
"""The process that hosts the V2X bus, and its role."""
WORLD_HOST = "sim"
"""The process that hosts the world bus, and its role."""
REGION_ROLES = ("edge", "signal", "infra")
"""Roles of which a run has a process for each region; `infra` where the region has mounts."""
AGENT_ROLES = ("infra", "vehicle")
"""Roles whose processes host agents."""
REGION_ID = r"[A-Za-z0-9_.-]+"

_VEHICLE_ID = re.compile(r"vehicle-(0|[1-9]\d{0,3})")
_REGION_PROCESS = re.compile(rf"({'|'.join(REGION_ROLES)})-({REGION_ID})")


@dataclass(frozen=True, slots=True)
class Instance:
    """A process: its id (part of its keys and its certificate's common name), role and region.

    `region` is empty where the process serves no single one.
    """

    id: str
    role: str
    region: str = ""


def instances_of(scenario: Mapping[str, Any]) -> list[Instance]:
    """Returns the processes that a run of a scenario begins with, as its setup has it.

    There, `regions` are the signals by region, and each of `roadside_mounts` names its signal.
    """
    single = [ROUTER, WORLD_HOST, "record"]
    single += ["mcap"] if scenario.get("record", {}).get("mcap") else []
    found = [Instance(role, role) for role in single]
    for role in REGION_ROLES:
        regions = [r for r in scenario["regions"] if role != "infra" or mounts_in(scenario, r)]
        found += region_instances(role, regions)
    return found + vehicle_instances(scenario["processes"]["vehicle"])


def region_instances(role: str, regions: Iterable[str]) -> list[Instance]:
    """Returns a role's process for each region."""
    return [Instance(f"{role}-{region}", role, region) for region in regions]


def vehicle_instances(count: int) -> list[Instance]:
    """Returns the first `count` vehicle processes."""
    return [Instance(f"vehicle-{number}", "vehicle") for number in range(count)]


def mounts_in(scenario: Mapping[str, Any], region: str) -> list[Any]:
    """Returns the roadside mounts at a region's junctions."""
    junctions = scenario["regions"][region]
    return [mount for mount in scenario["roadside_mounts"] if mount["tls"] in junctions]


def parse_id(process_id: str) -> Instance | None:
    """Parses a process id; None if it is not one."""
    if process_id in (ROUTER, WORLD_HOST, "record", "mcap"):
        return Instance(process_id, process_id)
    if _VEHICLE_ID.fullmatch(process_id):
        return Instance(process_id, "vehicle")
    match = _REGION_PROCESS.fullmatch(process_id)
    return None if match is None else Instance(process_id, match[1], match[2])


def vehicle_number(process_id: str) -> int:
    """Returns the number of a vehicle process, -1 of any other id."""
    match = _VEHICLE_ID.fullmatch(process_id)
    return -1 if match is None else int(match[1])


def region_of(process_id: str) -> str:
    """Returns the region that a process serves by its id, empty if that is no single one."""
    instance = parse_id(process_id)
    return "" if instance is None else instance.region


def role_of(process_id: str) -> str:
    """Returns the role in a process id."""
    return process_id.partition("-")[0]
