"""Configuration of sensors, scene, upload policies and pose errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from protocol.config import Section
from protocol.plugins import Catalogue, PluginSettings
from protocol.scans import Profile, ScanPattern
from sensing.limits import MAX_COLUMNS
from sensing.sensor_models import SENSOR_MODELS
from sensing.upload_policies import POLICIES, Filter, PolicyName, policy_of

LIDAR_SOURCES = Catalogue("cpnet.lidar_sources", "LiDAR source", ("cast",))
"""Every source of scans by its name; `sensing.source` defines what a plug-in must be."""


LidarModel = Literal["full", "sparse", "hdl-64e", "vlp-32c", "pandar64", "os1-128"]
_SPARSE = {"channels": 16, "points_per_second": 288_000}  # 16 x 1800 x 10
_RINGS_OF_MODEL = "channels", "upper_fov", "lower_fov"
_OF_POWER = "rain_mm_h", "fog_visibility_m", "beam_divergence_mrad", "noise_filter"


def _model_defaults(name: object) -> dict[str, object]:
    if name == "sparse":
        return {**_SPARSE}
    if not isinstance(name, str) or (model := SENSOR_MODELS.get(name)) is None:
        return {}
    rings = model.elevations_deg
    return {
        "channels": len(rings),
        "points_per_second": len(rings) * model.columns * 10,
        "upper_fov": round(rings[0], 2),
        "lower_fov": round(rings[-1], 2),
        "range": model.range_m,
    }


class LidarConfig(Section):
    """A spinning LiDAR, with the attributes of CARLA's `sensor.lidar.ray_cast` by their names."""

    model: LidarModel = Field(
        "full",
        description="Defaults of channels and points_per_second: those below, or with sparse a "
        "quarter of both, as a 16-ring LiDAR has; rings lie at equal steps. Or a real LiDAR, with "
        "its own rings and range.",
    )
    channels: int = Field(64, ge=1, le=256, description="Number of lasers. CARLA: 32.")
    range: float = Field(
        120.0, gt=1, le=500, description="Farthest return in m. CARLA: 10; here a 64-ring LiDAR's."
    )
    points_per_second: int = Field(
        1_152_000,
        gt=0,
        description="Rays of all lasers per second. CARLA: 56000; here 64 x 1800 x 10.",
    )
    rotation_frequency: float = Field(
        10.0, gt=0, le=100, description="Revolutions per second; one scan is one. CARLA: 10."
    )
    upper_fov: float = Field(
        2.0, ge=-90, le=90, description="Elevation of the uppermost laser in deg. CARLA: 10."
    )
    lower_fov: float = Field(
        -24.9, ge=-90, le=90, description="Elevation of the lowest laser in deg. CARLA: -30."
    )
    atmosphere_attenuation_rate: float = Field(
        0.004, ge=0, le=1, description="Intensity is exp(-rate * range); per m. CARLA: 0.004."
    )
    dropoff_general_rate: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Share of rays that return nothing, whatever they hit. CARLA: 0.45, which "
        "halves the scan to spare a GPU; a real 64-ring LiDAR loses about a tenth.",
    )
    dropoff_intensity_limit: float = Field(
        0.8, gt=0, le=1, description="Returns of more than this intensity stay. CARLA: 0.8."
    )
    dropoff_zero_intensity: float = Field(
        0.4, ge=0, le=1, description="Share of returns of intensity 0 that are lost. CARLA: 0.4."
    )
    range_at_10_percent_m: float | None = Field(
        None,
        gt=1,
        le=500,
        description="How far a target of 10 % reflectivity is detected, m. Then how far others are "
        "follows from their material and the angle, and intensity is their reflectivity; "
        "atmosphere_attenuation_rate and dropoff_intensity_limit are not used. null: all surfaces "
        "alike, as in CARLA.",
    )
    beam_divergence_mrad: float = Field(
        0.0,
        ge=0,
        le=20,
        description="Full angle of a beam along its ring, across it half of that, mrad. At an edge "
        "a beam meets both surfaces. 0: beams are lines.",
    )
    rain_mm_h: float = Field(
        0.0, ge=0, le=200, description="Rain that weakens returns and returns beams itself, mm/h."
    )
    fog_visibility_m: float | None = Field(
        None, ge=20, le=100_000, description="Meteorological optical range, m. null: no fog."
    )
    noise_filter: bool = Field(
        False,
        description="Whether the sensor drops returns within 20 m of less than 1 % reflectivity, "
        "as those of drops and fog are.",
    )
    rolling_shutter: bool = Field(
        False,
        description="Whether others drive on during the revolution; a scan's time is its middle, "
        "when the sensor looks ahead. Agents undo their own motion.",
    )
    noise_stddev: float = Field(
        0.02,
        ge=0,
        le=1,
        description="Standard deviation of range noise along the ray in m. CARLA: 0; here a real "
        "LiDAR's 2 cm.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in_model(cls, given: object) -> object:
        return _model_defaults(given.get("model")) | given if isinstance(given, dict) else given

    @property
    def columns(self) -> int:
        """Rays of one laser in one revolution."""
        return round(self.points_per_second / (self.rotation_frequency * self.channels))

    @property
    def pattern(self) -> ScanPattern:
        """The firing pattern as the scan codec knows it."""
        if (model := SENSOR_MODELS.get(self.model)) is not None:
            return ScanPattern.of_rings(model.elevations_deg, self.columns)
        return ScanPattern(self.channels, self.columns, self.upper_fov, self.lower_fov)

    @model_validator(mode="after")
    def _check_pattern(self) -> Self:
        if not 1 <= self.columns <= MAX_COLUMNS:
            raise ValueError(
                f"points_per_second / (rotation_frequency * channels) is {self.columns} rays a "
                f"revolution and laser; allowed are 1 to {MAX_COLUMNS}"
            )
        if self.lower_fov > self.upper_fov:
            raise ValueError(
                f"lower_fov {self.lower_fov} deg lies above upper_fov {self.upper_fov} deg"
            )
        return self

    @model_validator(mode="after")
    def _check_model(self) -> Self:
        if self.model in SENSOR_MODELS:
            own = _model_defaults(self.model)
            for name in _RINGS_OF_MODEL:
                if getattr(self, name) != own[name]:
                    raise ValueError(
                        f"{name} is {getattr(self, name)}, a {self.model} has {own[name]}: leave "
                        "it out, or choose model full"
                    )
        return self

    @model_validator(mode="after")
    def _check_power(self) -> Self:
        given = [name for name in _OF_POWER if getattr(self, name)]
        if given and self.range_at_10_percent_m is None:
            raise ValueError(
                f"{given[0]} says how much light comes back: needs range_at_10_percent_m"
            )
        return self


class Mount(Section):
    """Position of a roadside unit's LiDAR, relative to the centre of its junction."""

    id: str = Field(
        "rsu-0", pattern=r"^[A-Za-z0-9_.-]+$", max_length=64, description="Name of the agent."
    )
    tls: str | None = Field(
        None, description="Signal of the junction where it stands; null: one at each junction."
    )
    x_m: float = Field(0.0, ge=-500, le=500, description="East of the junction's centre, m.")
    y_m: float = Field(0.0, ge=-500, le=500, description="North of the junction's centre, m.")
    height_m: float = Field(3.0, gt=0, le=30, description="Above the ground at that place, m.")
    yaw_deg: float = Field(0.0, ge=-360, le=360, description="Heading, deg CCW from east.")


class SceneConfig(Section):
    """The static world around the road, drawn by the scenario's seed."""

    terrain_amplitude_m: float = Field(
        0.12, ge=0, le=1, description="Largest undulation of the ground, up or down, m."
    )
    kerb_height_m: float = Field(0.12, ge=0, le=0.5, description="Height of kerbs; 0 for none, m.")
    sidewalk_width_m: float = Field(2.0, ge=0.3, le=10, description="Width behind the kerb, m.")
    building_setback_m: float = Field(
        9.0, ge=2, le=100, description="From the road's edge to the fronts, m."
    )
    building_density: float = Field(
        0.65, ge=0, le=1, description="Share of the road's frontage that is built up."
    )
    pole_spacing_m: float = Field(30.0, ge=5, le=1000, description="Between street lights, m.")
    trees_per_100m: float = Field(4.0, ge=0, le=20, description="Trees per 100 m of road's edge.")
    furniture_per_100m: float = Field(
        0.0,
        ge=0,
        le=30,
        description="Walls, fences, hedges, bushes, boxes, sheds, roofs on posts, houses and trees "
        "at the kerb per 100 m of road's edge.",
    )
    map_height_std_m: float = Field(
        0.0,
        ge=0,
        le=5,
        description="How far the heights of the map that agents and edges have are off, m.",
    )
    polygons: Path | None = Field(
        None, description="SUMO .poly.xml file whose buildings replace those drawn by seed."
    )


@dataclass(frozen=True, slots=True)
class Chosen:
    """A resolved upload policy and all filters, the policy's own included."""

    policy: PolicyName
    filters: frozenset[Filter]


class PoseErrorConfig(Section):
    """Errors of agents' own pose estimates."""

    position_std_m: float = Field(
        0.05, ge=0, le=10, description="CAV: standard deviation along x and y, m."
    )
    height_std_m: float = Field(0.05, ge=0, le=10, description="CAV: the same along z, m.")
    heading_std_deg: float = Field(
        0.1, ge=0, le=45, description="CAV: standard deviation of yaw, deg."
    )
    tilt_std_deg: float = Field(
        0.05, ge=0, le=45, description="CAV: standard deviation of roll and of pitch, deg."
    )
    cv_position_std_m: float = Field(
        1.5, ge=0, le=50, description="CV, with satellite positioning alone: the same for x and y."
    )
    cv_height_std_m: float = Field(3.0, ge=0, le=50, description="CV: the same for z, m.")
    cv_heading_std_deg: float = Field(
        2.0, ge=0, le=90, description="CV: standard deviation of yaw, deg."
    )
    bias_position_std_m: float = Field(
        0.0, ge=0, le=10, description="CAV: of an error that stays, along x and y each, m."
    )
    bias_height_std_m: float = Field(0.0, ge=0, le=10, description="CAV: the same along z, m.")
    bias_heading_std_deg: float = Field(
        0.0, ge=0, le=45, description="CAV: of an error of yaw that stays, deg."
    )
    drift_position_std_m: float = Field(
        0.0, ge=0, le=10, description="CAV: of an error that changes slowly, along x and y, m."
    )
    drift_height_std_m: float = Field(0.0, ge=0, le=10, description="CAV: the same along z, m.")
    drift_heading_std_deg: float = Field(
        0.0, ge=0, le=45, description="CAV: of an error of yaw that changes slowly, deg."
    )
    drift_time_s: float = Field(
        30.0, gt=0, le=3600, description="Correlation time of the errors that change slowly, s."
    )
    mount_position_std_m: float = Field(
        0.0, ge=0, le=1, description="Roadside unit: how far its survey is off, along each axis, m."
    )
    mount_heading_std_deg: float = Field(
        0.0, ge=0, le=5, description="Roadside unit: how far its surveyed yaw is off, deg."
    )
    mount_tilt_std_deg: float = Field(
        0.0, ge=0, le=5, description="Roadside unit: the same for roll and for pitch, deg."
    )
    clock_std_s: float = Field(
        0.0,
        ge=0,
        le=1,
        description="CAVs and roadside units: of how much later than it says an agent scans, s.",
    )


class UploadChoice(Section):
    """Upload policy and filters of one kind of agent, where they differ from the others'."""

    policy: PolicyName | None = Field(None, description="As upload.policy; null: the same.")
    filters: list[Filter] | None = Field(None, description="As upload.filters; null: the same.")


class UploadConfig(Section):
    """What agents send of a scan."""

    max_error_m: float = Field(
        0.02, ge=0.001, le=1, description="Farthest that encoding may move a point, m."
    )
    profile: Profile = Field(
        Profile.DEFAULT,
        description="How much time a scan may take to become small; the bound holds in every "
        "profile. fast: zstd; default: fewest bytes.",
    )
    intensity: bool = Field(False, description="Whether intensities are sent, a byte a ray.")
    policy: PolicyName = Field(
        "full",
        description="; ".join(f"{name}: {policy.about}" for name, policy in POLICIES.items())
        + "; or the name of a plug-in",
    )
    plugin: PluginSettings = Field({})
    filters: list[Filter] = Field(
        [],
        description="Further filters. roi: removes what is off the map's road; foreground: removes "
        "the ground and what a stationary sensor has learnt as background; of the rest, "
        "beams that crowd on near surfaces are thinned to one every `thin_m`.",
    )
    thin_m: float = Field(
        0.07, ge=0, le=2, description="foreground: most between beams of a ring, m; 0: no thinning"
    )
    roi_margin_m: float = Field(
        1.0, ge=0, le=20, description="How far beyond a lane's edge the road reaches for roi, m."
    )
    region_range_m: float = Field(
        100.0,
        ge=10,
        le=500,
        description="A CAV sends each region whose roads are nearer than this what covers them.",
    )
    vehicle: UploadChoice = Field(UploadChoice(), description="CAVs' own choice.")
    roadside: UploadChoice = Field(UploadChoice(), description="Roadside LiDARs' own choice.")

    def of(self, kind: Literal["vehicle", "roadside"]) -> Chosen:
        """Returns policy and filters of a kind of agent."""
        choice = self.vehicle if kind == "vehicle" else self.roadside
        policy = self.policy if choice.policy is None else choice.policy
        filters = self.filters if choice.filters is None else choice.filters
        return Chosen(policy, frozenset(filters) | frozenset(policy_of(policy).filters))

    @model_validator(mode="after")
    def _check_cells(self) -> Self:
        both = sorted({self.of("vehicle").policy, self.of("roadside").policy})
        if len(both) > 1 and all(policy_of(name).cells for name in both):
            raise ValueError(
                f"vehicles and roadside ask for {both[0]} and {both[1]}; all agents with cells "
                "share one plan: choose one of them for both"
            )
        return self
