"""The signal controller's part of a scenario."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from protocol.config import Section


class SignalConfig(Section):
    """Who decides on the phase; minimum green, yellow and all-red are the cabinet's."""

    policy: Literal["max_pressure", "fixed"] = Field(
        "max_pressure",
        description="max_pressure: the phase with most vehicles before it and fewest behind it, "
        "as in Chen et al. 2022; fixed: the plan that the net brings",
    )
