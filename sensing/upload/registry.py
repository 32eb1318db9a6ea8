"""The upload policies by name: the one list that scenarios, agents and the edge go by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

PolicyName = Literal["full", "roi", "foreground", "voronoi", "power", "reap", "objects", "pose"]
Filter = Literal["roi", "foreground"]
Sends = Literal["scan", "objects", "nothing"]


@dataclass(frozen=True, slots=True)
class Policy:
    """What an agent uploads.

    Attributes:
        about: one line for people.
        sends: chunks of its scan, boxes of what it detects, or no more than its pose.
        filters: what is left out whatever else the scenario says.
        cells: whether the edge's plan says which part of the scene is the agent's.
        weighted: whether cells follow estimated bandwidths.
        chunks: into how many chunks a scan is cut by a plan; the last is the whole rest if there
            are more than one.
    """

    about: str
    sends: Sends = "scan"
    filters: tuple[Filter, ...] = ()
    cells: bool = False
    weighted: bool = False
    chunks: int = 1


POLICIES: dict[PolicyName, Policy] = {
    "full": Policy("the whole scan"),
    "roi": Policy("what lies on the map's road", filters=("roi",)),
    "foreground": Policy("no ground, background or crowded beams", filters=("foreground",)),
    "voronoi": Policy("the places nearest to the agent", cells=True),
    "power": Policy("the same, more for a faster uplink", cells=True, weighted=True),
    "reap": Policy(
        "the same in four chunks, by borders drawn for wrong estimates too; ends early",
        cells=True,
        weighted=True,
        chunks=4,
    ),
    "objects": Policy("boxes of what the agent detects for itself", sends="objects"),
    "pose": Policy("the agent's pose alone", sends="nothing"),
}
"""Every policy by its name."""

assert tuple(POLICIES) == get_args(PolicyName)
