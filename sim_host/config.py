"""Configuration of traffic and of the signal cabinet."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from protocol.config import Section

MeshName = Literal[
    "car", "microcargo", "minibus", "lorry", "articulated", "bus", "motorcycle", "bicycle", "box"
]
VehicleClassName = Literal[
    "passenger", "delivery", "truck", "trailer", "bus", "motorcycle", "bicycle"
]


NetworkName = Literal["t_junction", "corridor", "grid", "town"]
"""Built-in networks."""


class VehicleSpec(Section):
    """One kind of vehicle of the generated demand."""

    name: str = Field("car", description="name of the SUMO vType", pattern=r"^[A-Za-z0-9_\-]+$")
    v_class: VehicleClassName = Field(
        "passenger",
        description="SUMO's vClass: how it drives, which lanes it may use, and what detectors call "
        "it: a truck (truck, trailer, bus), a two-wheeler (motorcycle, bicycle), else a car",
    )
    mesh: MeshName = Field("car", description="shape that sensors see, scaled to the sizes below")
    length_m: float = Field(4.5, description="bumper to bumper", gt=0.5, le=30)
    width_m: float = Field(1.8, description="without mirrors", gt=0.3, le=3)
    height_m: float = Field(1.5, description="ground to roof", gt=0.3, le=5)
    share: float = Field(1.0, description="weight among all kinds", gt=0)


def _default_vehicles() -> list[VehicleSpec]:
    # All pass the size filter of Chen et al. 2022: no longer than 6 m, no higher than 2 m.
    return [
        VehicleSpec(name="small", length_m=3.9, width_m=1.7, height_m=1.45, share=0.3),
        VehicleSpec(name="sedan", length_m=4.5, width_m=1.8, height_m=1.5, share=0.4),
        VehicleSpec(name="estate", length_m=4.8, width_m=1.9, height_m=1.7, share=0.2),
        VehicleSpec(
            name="van", mesh="microcargo", length_m=4.9, width_m=1.9, height_m=1.95, share=0.1
        ),
    ]


class LateralConfig(Section):
    """Lateral positions of vehicles in lanes: by default the middle, and instant lane changes."""

    lane_change_s: float = Field(
        0, description="time that a lane change takes; 0: as the sumocfg says, or none", ge=0, le=20
    )
    offset_std_m: float = Field(
        0, description="standard deviation, between vehicles, of how far off the middle", ge=0, le=1
    )
    wander_std_m: float = Field(
        0, description="the same of one vehicle along its way, in waves of 80 to 320 m", ge=0, le=1
    )
    bicycle_edge_m: float | None = Field(
        None,
        description="bicycles' middle from the right edge of their lane; null: as all others",
        gt=0,
        le=3,
    )


class TrafficConfig(Section):
    """Roads and demand: of a built-in network, or of the user's `net` or `sumocfg`."""

    network: NetworkName = Field(
        "t_junction", description="built-in network that is used without net and sumocfg"
    )

    grid_size: int = Field(4, description="crossings a side of the network grid", ge=1, le=26)
    grade: float = Field(
        0,
        description="corridor, grid, town: how steep the steepest street is, climb over length; "
        "0: level",
        ge=0,
        le=0.12,
    )
    net: str | None = Field(
        None, description="a SUMO .net.xml; without routes, demand is generated for it"
    )
    routes: str | None = Field(
        None,
        description="a .rou.xml with demand of its own for `net`, sorted by departure; SUMO begins "
        "with the first",
    )
    sumocfg: str | None = Field(None, description="a .sumocfg with a net and a demand of its own")
    step_s: float = Field(0.1, description="SUMO step; milliseconds count", ge=0.01, le=1)
    warmup_s: float = Field(
        60, description="time on the fixed plan, without sensors, before frame 0", ge=0, le=7200
    )
    demand_vph_per_lane: dict[str, float] = Field(
        {}, description="one signal: vehicles per hour and lane by id of the edge that ends there"
    )
    saturation: float = Field(
        0.8,
        gt=0,
        le=2,
        description="several signals: demand is scaled until the most loaded approach has this "
        "degree of saturation (v/c) on the fixed plan",
    )
    default_demand_vph_per_lane: float = Field(
        500,
        description="the same for edges not named (t_junction: its side road has 360)",
        ge=0,
        le=3600,
    )
    vehicles: list[VehicleSpec] = Field(
        default_factory=_default_vehicles, description="vehicle mix of the demand", min_length=1
    )
    lateral: LateralConfig = Field(LateralConfig(), description="where in their lanes vehicles are")
    parked_per_100m: float = Field(
        0,
        description="parked cars per 100 m of kerb, away from junctions; a space takes 6.5 m",
        ge=0,
        le=15,
    )
    pedestrians_per_hour: float = Field(
        0, description="people who cross each arm of each junction, per hour", ge=0, le=1000
    )
    cav_rate: float = Field(0.05, description="share of vehicles with LiDAR and radio", ge=0, le=1)
    cv_rate: float = Field(0.0, description="share of vehicles with a radio alone", ge=0, le=1)
    radius_m: float = Field(
        450, description="vehicles farther from all signals exist for SUMO alone", ge=50, le=5000
    )
    start_timeout_s: float = Field(
        120, description="how long to wait until all processes are ready", gt=0
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.net and self.sumocfg:
            raise ValueError("give net or sumocfg, not both: a sumocfg names its own net")
        if self.routes and not self.net:
            raise ValueError("routes needs net; a sumocfg names its own routes")
        if self.routes and self.demand_vph_per_lane:
            raise ValueError("give routes or demand_vph_per_lane, not both")
        if self.cav_rate + self.cv_rate > 1:
            raise ValueError(f"cav_rate {self.cav_rate} + cv_rate {self.cv_rate} is more than 1")
        for edge, rate in self.demand_vph_per_lane.items():
            if not 0 <= rate <= 3600:
                raise ValueError(f"demand_vph_per_lane.{edge} is {rate}, allowed: 0 to 3600")
        names = [spec.name for spec in self.vehicles]
        if len(set(names)) < len(names):
            raise ValueError(f"vehicles have the names {names}, each may stand once")
        return self


class CabinetConfig(Section):
    """Times that the signal cabinet enforces, whatever is requested."""

    min_green_s: float = Field(5, description="a green lasts at least this long", ge=0, le=120)
    yellow_s: float = Field(4, description="yellow after a green", gt=0, le=20)
    all_red_s: float = Field(1, description="red before the next green", ge=0, le=20)
    control: Literal["requests", "actuated"] = Field(
        "requests",
        description="requests: shows what is requested, where it is safe; actuated: SUMO's own "
        "control with loop detectors before the stop bars, which ignores requests",
    )
    max_green_s: float = Field(
        50, description="actuated: longest green while others wait", gt=0, le=600
    )
    max_gap_s: float = Field(
        3, description="actuated: a green ends when no loop saw a vehicle for so long", gt=0, le=60
    )
    detector_gap_s: float = Field(
        2,
        description="actuated: loops lie so far before the stop bar, at the speed limit",
        gt=0,
        le=60,
    )
    stale_after_s: float = Field(
        3,
        description="simulated time without a valid request until the fixed plan runs",
        gt=0,
        le=86_400,
    )
    plan_greens_s: list[Annotated[float, Field(ge=1, le=600)]] = Field(
        [],
        description="one signal: durations of the greens of the fixed plan, in its order, such as "
        "Webster's for the demand; none: the net's own",
    )
    request_timeout_s: float = Field(
        60, description="lockstep: wall time to wait for a frame's request before giving up", gt=0
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.max_green_s < self.min_green_s:
            raise ValueError(
                f"max_green_s {self.max_green_s:g} is less than min_green_s {self.min_green_s:g}"
            )
        return self
