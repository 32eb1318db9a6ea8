"""Where the CARLA server is, and how its world lies in the net."""

from __future__ import annotations

from pydantic import Field

from protocol.config import Section


class CarlaConfig(Section):
    """The CARLA server that casts scans where `lidar.source` is carla."""

    host: str = Field("127.0.0.1", description="its machine; that of all agents that share it")
    port: int = Field(2000, ge=1, le=65_535, description="its port for commands")
    timeout_s: float = Field(60.0, gt=0, le=3600, description="how long it may take to answer")
    town: str | None = Field(
        None, description="map to be loaded, such as Town04; null: what is loaded there"
    )
    net_offset_m: tuple[float, float] = Field(
        (0.0, 0.0), description="the net's netOffset, in its <location>: where CARLA's 0, 0 lies"
    )
    blueprints: dict[str, str] = Field(
        {},
        description="by name of the SUMO vType; others look like a car, a van or a bus by their "
        "mesh",
    )
