"""`cpnet eval --tracks RUN`: tracking measures of a run against ground truth.

Vehicles in coverage are to be tracked: those in the area of E-CVPR (`studies.ecvpr`) within the
range of a LiDAR, and there those that report themselves. Boxes of people are ignored, and false
boxes outside the area.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.arrays import Floats
from protocol.errors import ConfigError
from protocol.extras import to_install
from protocol.messages import VehicleType, is_bystander
from recording.run import Run
from recording.tables import DetectionRow, TruthRow
from studies.coasting import CoastingScore, coasting_score
from studies.ecvpr import (
    DOWNSTREAM_M,
    UPSTREAM_M,
    EvaluationArea,
    PerceptionBounds,
    parked_bodies,
    vehicles_of,
)
from studies.frame_rows import perceived_by_frame
from studies.over_time import FrameClock
from studies.page.model import DASH
from studies.tracking import (
    MemoryScore,
    Rows,
    Sequences,
    TrackedFrame,
    TrackScore,
    bev_iou,
    centre_similarity,
    memory_score,
    percent,
)


@dataclass(frozen=True, slots=True)
class RunTracks:
    """Tracking measures of a run's vehicles in coverage."""

    score: TrackScore
    hota_iou: float | None
    memory: MemoryScore
    coasting: CoastingScore

    def as_json(self) -> dict[str, Any]:
        """Returns the measures by stable keys; shares are from 0 to 1."""
        memory, coasting = self.memory, self.coasting
        return {
            **asdict(self.score),
            "hota_iou": self.hota_iou,
            "speed_rmse_mps": {
                "observed": memory.observed_rmse_mps,
                "coasted": memory.coasted_rmse_mps,
            },
            "precision": coasting.precision,
            "ecvpr": coasting.ecvpr,
            "hidden": {"vehicles": memory.hidden, "recovered": memory.recovered_share},
            "coasted_3s": {"boxes": memory.coasted, "within_2m": memory.near_share},
        }

    def as_text(self) -> Rows:
        """Returns the measures by readable names."""
        memory, coasting = self.memory, self.coasting
        return (
            *self.score.as_text(),
            ("HOTA, IoU from above", percent(self.hota_iou)),
            ("speed RMSE, observed", _mps(memory.observed_rmse_mps)),
            ("  coasted", _mps(memory.coasted_rmse_mps)),
            ("precision of observed boxes", percent(coasting.precision["observed"])),
            ("  of coasted ones", percent(coasting.precision["coasted"])),
            ("  of all", percent(coasting.precision["all"])),
            ("E-CVPR of observed boxes", percent(coasting.ecvpr["observed"])),
            ("  of all", percent(coasting.ecvpr["all"])),
            ("  bound: visible so far", percent(coasting.ecvpr["visible_so_far"])),
            ("  bound: in range so far", percent(coasting.ecvpr["in_range_so_far"])),
            (f"hidden up to 5 s ({memory.hidden}), same id", percent(memory.recovered_share)),
            (f"coasted 3 s ({memory.coasted}), within 2 m", percent(memory.near_share)),
        )


def evaluate_run(run_dir: Path) -> RunTracks:
    """Compares the tracks of a run with the truth.

    Raises:
        ConfigError: the folder is no whole run, it has no tracks or no truth, or a library is
            missing.
    """
    try:
        import motrics  # noqa: F401 - a missing package is reported before a run is read
        import scipy  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--tracks needs {error.name} (extra `study`): {to_install('study')}"
        ) from None
    with Run(run_dir) as run:
        if not run.query("SELECT 1 FROM detections WHERE track > 0 LIMIT 1"):
            raise ConfigError(
                f"{run_dir}: the run has no tracks; a run with edge.tracking.enabled has them"
            )
        frames = list(tracked_frames(run))
        if not frames:
            raise ConfigError(f"{run_dir}: no frame of the run has both truth and detections")
        coasting = coasting_score(run)
    return RunTracks(
        TrackScore.of(Sequences.of(frames, centre_similarity)),
        TrackScore.hota_of(Sequences.of(frames, bev_iou)),
        memory_score(frames),
        coasting,
    )


def tracked_frames(run: Run) -> Iterator[TrackedFrame]:
    """Yields the frames that have truth and were perceived.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    area, bounds, clock = (
        EvaluationArea(run.setup.road_map),
        PerceptionBounds(run),
        FrameClock.of(run),
    )
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    parked = parked_bodies(run.setup)
    for frame, found, bodies in perceived_by_frame(run):
        traffic = [one for one in bodies if not is_bystander(one.vehicle)]
        covered = bounds.in_range(traffic) if traffic else set()
        due = [
            one.vehicle in covered and area.contains(one.lane, one.lane_position_m)
            for one in traffic
        ]
        vehicles, boxes = traffic + parked, vehicles_of(found)
        yield TrackedFrame(
            time_s=clock[frame],
            vehicles=[one.vehicle for one in vehicles],
            vehicle_boxes=_bodies(vehicles, types),
            vehicle_speeds_mps=np.array([one.speed_mps for one in vehicles], np.float64),
            due=np.array(due + [False] * len(parked), np.bool_),
            tracks=[one.track or f"{frame} {one.region} {one.detection}" for one in boxes],
            boxes=np.array([one[3:10] for one in boxes], np.float64).reshape(-1, 7),
            speeds_mps=np.array([one.speed_mps for one in boxes], np.float64),
            scores=np.array([one.score for one in boxes], np.float64),
            coasted_s=np.array([one.coasted_s for one in boxes], np.float64),
            inside=np.array([_is_inside(one) for one in boxes], np.bool_),
        )


def _is_inside(one: DetectionRow) -> bool:
    """Whether a box is in the area of E-CVPR, or off the lanes, where no vehicle should be."""
    return not one.lane or -DOWNSTREAM_M <= one.distance_m <= UPSTREAM_M


def _bodies(vehicles: list[TruthRow], types: dict[str, VehicleType]) -> Floats:
    """Returns vehicles as boxes (N, 7)."""
    boxes = np.zeros((len(vehicles), 7))
    for box_, one in zip(boxes, vehicles, strict=True):
        kind = types.get(one.type)
        length_m, width_m, height_m = (
            (kind.length_m, kind.width_m, kind.height_m) if kind else (0.0, 0.0, 0.0)
        )
        centre_m = one.x_m, one.y_m, one.z_m + height_m / 2
        box_[:] = *centre_m, length_m, width_m, height_m, one.yaw_rad
    return boxes


def _mps(value: float | None) -> str:
    return DASH if value is None else f"{value:.2f} m/s"
