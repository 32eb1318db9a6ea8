"""Upload policies by name: the list that scenarios, agents and the edge share.

The entry point of a plug-in (group `cpnet.upload_policies`) names a `Policy`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import AfterValidator

from protocol.plugins import Catalogue
from sensing.limits import MAX_CHUNKS

if TYPE_CHECKING:
    from sensing.upload_selection import ChooserMaker


Filter = Literal["roi", "foreground"]
Sends = Literal["scan", "objects", "nothing"]


@dataclass(frozen=True, slots=True)
class Policy:
    """What an agent uploads.

    Attributes:
        about: one line for people.
        sends: chunks of its scan, boxes of what it detects, or no more than its pose.
        filters: apply whatever else the scenario says.
        cells: whether the edge's plan says which part of the scene is the agent's.
        weighted: whether cells follow estimated bandwidths.
        chunks: into how many chunks a scan is cut. By a plan, the last is the whole rest if there
            are more than one.
        chooser: makes what chooses, beam by beam, among those that the filters leave; without
            cells alone.
    """

    about: str
    sends: Sends = "scan"
    filters: tuple[Filter, ...] = ()
    cells: bool = False
    weighted: bool = False
    chunks: int = 1
    chooser: ChooserMaker | None = None

    def __post_init__(self) -> None:
        unknown = [*{*self.filters} - {*get_args(Filter)}, *{self.sends} - {*get_args(Sends)}]
        if unknown:
            known = ", ".join([*get_args(Filter), *get_args(Sends)])
            raise ValueError(f"policy with {unknown[0]!r}: filters and sends are of {known}")
        if not 1 <= self.chunks <= MAX_CHUNKS:
            raise ValueError(f"policy of {self.chunks} chunks: must be 1 to {MAX_CHUNKS}")
        if self.chooser is not None and (self.cells or self.sends != "scan"):
            raise ValueError("a policy with a chooser sends scans, without cells")
        if self.chunks > 1 and not (self.cells or self.chooser):
            raise ValueError(f"policy of {self.chunks} chunks: needs cells or a chooser")


POLICIES: dict[str, Policy] = {
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
"""Every built-in policy by its name."""

NAMES = Catalogue("cpnet.upload_policies", "upload policy", tuple(POLICIES))
PolicyName = Annotated[str, AfterValidator(NAMES.checked)]


def policy_of(name: str) -> Policy:
    """Returns the policy of a name, built in or a plug-in's.

    Raises:
        ConfigError: there is none, or the plug-in cannot be imported or is no policy.
    """
    if name in POLICIES:
        return POLICIES[name]
    plugin = NAMES.load(name)
    if not isinstance(plugin.value, Policy):
        raise plugin.wrong(f"is a {type(plugin.value).__name__}, must be a {Policy.__name__}")
    return plugin.value
