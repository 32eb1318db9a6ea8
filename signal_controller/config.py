"""The signal controller's part of a scenario."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from protocol.config import Section
from protocol.plugins import Catalogue, PluginSettings

POLICIES = Catalogue(
    "cpnet.signal_policies", "signal policy", ("predictive", "max_pressure", "fixed")
)
"""Every policy by its name; `signal_controller.policies` defines what a plug-in must be."""


class SignalConfig(Section):
    """The policy that chooses the phase; minimum green, yellow and all-red are the cabinet's."""

    policy: Annotated[str, AfterValidator(POLICIES.checked)] = Field(
        "predictive",
        description="predictive: a plan over a rolling horizon, from where single vehicles are; "
        "max_pressure: the phase with most vehicles before it and fewest behind it, "
        "as in Chen et al. 2022; fixed: the net's own plan; or the name of a plug-in",
    )
    phases: Literal["auto", "plan", "compatible"] = Field(
        "auto",
        description="greens that a policy may choose. plan: those of the net's plan; compatible: "
        "beside them, the largest sets of signal groups without a conflict, 16 phases in all; "
        "auto: compatible for predictive, plan for all others",
    )
    horizon_s: float = Field(
        60, ge=20, le=120, description="predictive: how far ahead it plans; whole seconds count"
    )
    max_red_s: float = Field(
        120,
        ge=30,
        le=600,
        description="predictive: a movement for which somebody has waited so long comes next",
    )
    pedestrian_green_s: float = Field(
        7, ge=0, le=60, description="predictive: least green of a phase in which people walk"
    )
    speed_advice: bool = Field(
        False,
        description="predictive: vehicles that report themselves are advised the speed at which "
        "they reach the stop bar when they may pass (GLOSA), and drive so",
    )
    advice_min_mps: float = Field(
        5, ge=1, le=30, description="who would have to drive slower than this is not advised"
    )
    plugin: PluginSettings = Field({})
    unseen: Literal["alike", "empty"] = Field(
        "alike",
        description="what max_pressure assumes of the part of a lane that no LiDAR has within "
        "range (edge.coverage_range_m): alike, it is as full as the rest of the lane, and of a "
        "lane that no LiDAR covers the number is estimated; empty, as in Chen et al. 2022",
    )
    estimator_inflow_vph: float = Field(
        500,
        ge=0,
        le=3600,
        description="vehicles per hour that come to a lane that no LiDAR covers; the default is "
        "the demand in Chen et al. 2022",
    )
    estimator_saturation_vph: float = Field(
        1800, gt=0, le=7200, description="vehicles per hour that leave it while it is green"
    )
    estimator_timeout_s: float = Field(
        60,
        gt=0,
        le=3600,
        description="simulated time for which numbers are estimated without any lane before "
        "the stop bar being seen; then the fixed plan is requested, until one is",
    )
    weight: Literal["vehicles", "pcu", "queued"] = Field(
        "vehicles",
        description="what max_pressure counts: vehicles, as in Chen et al. 2022; passenger-car "
        "units, of which a lorry or bus has 2 and a two-wheeler 0.4; or vehicles that "
        "stand still (edge.stationary_mps); how far from the stop bar, edge.upstream_m and "
        "edge.downstream_m say",
    )
    hold_s: float = Field(
        0,
        ge=0,
        le=120,
        description="ours. max_pressure: a green lasts so long before pressures may end it; 0 is "
        "Chen et al. 2022, where the cabinet's minimum green alone holds it",
    )
    stale_after_s: float = Field(
        1.0,
        gt=0,
        le=3600,
        description="counts farther than this, in simulated time, from the signal's newest state "
        "are not acted on",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.speed_advice and self.policy != "predictive":
            raise ValueError(
                f"speed_advice needs policy predictive, which plans ahead; policy is {self.policy}"
            )
        return self


def check_policy(config: SignalConfig) -> None:
    """Checks before a start that the policy of a configuration can be loaded.

    Raises:
        ConfigError: it cannot be imported.
    """
    if config.policy not in POLICIES.builtin:
        POLICIES.load(config.policy)
