"""Configuration of detection. Defaults are those of Chen et al. 2022, ours are marked."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from protocol.config import Section
from protocol.plugins import Catalogue, PluginSettings

LEARNED = ("pointpillars", "pointpillars-full")
DETECTORS = Catalogue("cpnet.detectors", "detector", ("fast", "reference", *LEARNED))
"""Every detector by its name; what an installed one must be, `perception.registry` says."""
DetectorName = Annotated[str, AfterValidator(DETECTORS.checked)]


class GeofenceConfig(Section):
    """Geofence: points and detections off the road are left out."""

    margin_m: float = Field(
        0.5, ge=0, le=5, description="ours: how far beyond a lane's edge the road reaches"
    )
    below_m: float = Field(
        2.0, gt=0, le=50, description="ours: points deeper below the road's height are left out"
    )
    above_m: float = Field(
        5.0, gt=0, le=50, description="ours: points higher above the road's height are left out"
    )


class GroundConfig(Section):
    """RANSAC planes that take the ground away."""

    runs: int = Field(2, ge=0, le=5, description="planes removed, one after the other")
    distance_m: float = Field(0.2, gt=0, le=1, description="points this close to a plane are on it")
    max_iterations: int = Field(
        3000, ge=1, le=100_000, description="hypotheses at most, of 3 points"
    )
    tile_m: float | None = Field(
        20.0,
        ge=5,
        description="ours: planes are fitted for each square tile of this side, because a road "
        "climbs and bends; null for planes over the whole cloud, as in the paper",
    )
    max_slope_deg: float = Field(
        2.0,
        gt=0,
        le=45,
        description="ours: a tile's plane at a larger angle to the road map is no ground",
    )
    max_offset_m: float = Field(
        0.3,
        gt=0,
        description="ours: a tile's plane farther from the road map's height is no ground",
    )


class ClusterConfig(Section):
    """DBSCAN."""

    eps_m: float = Field(1.25, gt=0, le=5, description="points this close are neighbours")
    min_points: int = Field(
        3, ge=1, le=100, description="neighbours, itself included, that make a core point"
    )
    split_eps_m: float | None = Field(
        0.6,
        gt=0,
        le=5,
        description="ours: clusters too long for one vehicle are clustered anew with this in the "
        "place of eps_m; null to leave them, as in the paper",
    )


class BoxConfig(Section):
    """The paper's size filter, which `reference` applies; whether `fast` completes its boxes."""

    completed: bool = Field(
        True,
        description="ours: boxes of `fast` are completed to the usual size of their class; false: "
        "they hold the points of a cluster and no more, as in the paper and in `reference`",
    )
    min_length_m: float = Field(0.5, ge=0, description="shorter boxes are no vehicles")
    max_length_m: float = Field(6.0, gt=0, description="longer boxes are no vehicles")
    min_width_m: float = Field(0.5, ge=0, description="narrower boxes are no vehicles")
    max_width_m: float = Field(3.0, gt=0, description="wider boxes are no vehicles")
    min_height_m: float = Field(0.1, ge=0, description="lower boxes are no vehicles")
    max_height_m: float = Field(2.0, gt=0, description="higher boxes are no vehicles")

    @model_validator(mode="after")
    def _ordered(self) -> BoxConfig:
        for side in ("length", "width", "height"):
            least, most = getattr(self, f"min_{side}_m"), getattr(self, f"max_{side}_m")
            if least > most:
                raise ValueError(f"min_{side}_m is {least}, more than max_{side}_m, {most}")
        return self


class PillarsDetection(Section):
    """PointPillars: which weights, and which of its boxes are vehicles."""

    weights: str | None = Field(None, description="a safetensors file; null: those shipped")
    min_score: float = Field(
        0.32, gt=0, lt=1, description="ours: boxes of a lower score are no vehicles"
    )
    same_iou: float = Field(
        0.1, ge=0, le=1, description="ours: of two boxes that overlap more, one goes"
    )


class DetectionConfig(Section):
    """Detection, from points to vehicles, on the edge or on agents."""

    detector: DetectorName = Field(
        "fast",
        description="fast (ours): clustering tile by tile, boxes completed; reference: clustering "
        "as in the paper, by Open3D (extra `reference`); pointpillars, pointpillars-full: learned; "
        "or the name of a plug-in",
    )
    plugin: PluginSettings = Field({})
    geofence: GeofenceConfig = Field(GeofenceConfig(), description="what belongs to the road")
    ground: GroundConfig = Field(GroundConfig(), description="ground removal, RANSAC")
    cluster: ClusterConfig = Field(ClusterConfig(), description="clustering, DBSCAN")
    solid_only: bool = Field(
        False,
        description="ours: boxes that a sensor looks through, or over whose roof a column goes on, "
        "are no vehicles, as for PointPillars always; nor are those of which less than five points "
        "or a 13th of a sensor's rays towards them are seen, or that rays go deep into; and "
        "PointPillars looks for vehicles on lower ground where that is hidden. Without a road map, "
        "where hedges and walls stand on the road, it is true",
    )
    boxes: BoxConfig = Field(
        BoxConfig(), description="size filter of `reference`, completion of `fast`"
    )
    pillars: PillarsDetection = Field(PillarsDetection(), description="PointPillars")
