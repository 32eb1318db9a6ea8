"""The sensors that observe a junction."""

from __future__ import annotations

from dataclasses import dataclass

from learning.layout import Kind
from learning.sites import Site
from sensing.config import LidarConfig, Mount, PoseErrorConfig


@dataclass(frozen=True, slots=True)
class Sensors:
    """LiDARs of posts and of CAVs: what they are, where they stand, how well CAVs know that.

    Without `mounts`, posts are drawn beside the road. `roof_m` is the range of the CAVs' sensor
    heights.
    """

    roadside: LidarConfig
    vehicle: LidarConfig
    mounts: tuple[Mount, ...] | None
    roof_m: tuple[float, float]
    pose: PoseErrorConfig

    @classmethod
    def drawn(cls, site: Site) -> Sensors:
        """Returns those of a generated network."""
        return cls(site.lidar, site.lidar, None, site.roof_m, PoseErrorConfig())

    def lidar(self, kind: Kind) -> LidarConfig:
        """Returns the LiDAR of posts or of CAVs."""
        return self.roadside if kind == "roadside" else self.vehicle
