"""The link section of a scenario."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, field_validator

from protocol.config import Section
from sensing.link.named import profile_named
from sensing.link.profile import LinkProfile


class LinkConfig(Section):
    """The network between agents and edge. Without profiles it is as fast as the machine.

    A profile is written as `none`, a built-in name, `5mbit`, `5mbit,20ms`, a trace file, or in
    full; the scenario keeps it in full, so that other machines need no file.
    """

    profile: LinkProfile | None = Field(None, description="of every vehicle with a radio")
    roadside_profile: LinkProfile | None = Field(
        None, description="of every roadside LiDAR; null: it is wired and has no limits"
    )
    apply: Literal["auto", "virtual", "emulated", "none"] = Field(
        "auto",
        description="virtual: arrival in simulated time, for lockstep; emulated: a shaping relay, "
        "for realtime; auto: virtual or emulated, whichever fits the mode; none: profiles are not "
        "applied",
    )
    agent_compute_ms: float = Field(
        0.0, ge=0, le=10_000, description="virtual: from the frame's time until an agent sends"
    )
    edge_compute_ms: float = Field(
        0.0, ge=0, le=10_000, description="virtual: from the last arrival until the request is out"
    )

    @classmethod
    def of(cls, scenario: dict[str, Any]) -> Self:
        """Reads the section of a scenario's data."""
        return cls.model_validate(scenario.get("link", {}))

    @field_validator("profile", "roadside_profile", mode="before")
    @classmethod
    def _by_name(cls, value: object) -> object:
        return profile_named(value) if isinstance(value, str) else value

    def way(self, mode: str) -> Literal["virtual", "emulated", "none"]:
        """Returns how links are applied in a mode."""
        if self.apply == "none" or (self.profile is None and self.roadside_profile is None):
            return "none"
        return "virtual" if mode == "lockstep" else "emulated"
