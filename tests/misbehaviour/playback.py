"""A recorded run's frames as the edge had them, from its snapshots, to check them again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.frame import Chunk, Frame
from protocol.codec import decode
from protocol.messages import AgentPose, Equipment, VehicleType
from recording.run import Run
from recording.tables import CloudRow, TruthRow
from sensing.config import PoseErrorConfig, UploadConfig
from sensing.noise import stream
from sensing.pose import estimated_pose, position_std_m


def frames_of(run_dir: Path) -> Iterator[Frame]:
    """Yields the frames of a run that kept a snapshot of each (`record.snapshot_period_s`).

    Poses are the agents' estimates: their errors follow from the seed.

    Raises:
        ConfigError: the folder is no run.
    """
    with Run(run_dir) as run:
        types = {kind.name: kind for kind in run.setup.vehicle_types}
        last = run.query("SELECT max(frame) FROM clouds")[0][0]
        for number in range(-1 if last is None else last + 1):
            truth = run.of_frame(TruthRow, number)
            poses = [_pose(run.scenario, row, types) for row in truth if row.equipment]
            clouds = run.of_frame(CloudRow, number)
            chunks = [_piece(run.scenario, row) for row in clouds]
            yield Frame(
                number,
                _time_ns(run.scenario, number),
                sorted({p.agent for p in poses} | {p.agent for p in chunks}),
                sorted(poses, key=lambda pose: pose.agent),
                sorted(chunks, key=lambda chunk: (chunk.agent, chunk.index)),
                complete=True,
                first_ns=0,
                ready_ns=0,
            )


def _pose(scenario: dict[str, Any], row: TruthRow, types: dict[str, VehicleType]) -> AgentPose:
    errors = PoseErrorConfig.model_validate(scenario["pose"])
    equipment, kind = Equipment(row.equipment), types[row.type]
    true_pose = [row.x_m, row.y_m, row.z_m, row.roll_rad, row.pitch_rad, row.yaw_rad]
    rng = stream(scenario["seed"], "pose", row.vehicle, row.frame)
    return AgentPose(
        frame=row.frame,
        sim_time_ns=_time_ns(scenario, row.frame),
        agent=row.vehicle,
        equipment=equipment,
        pose=estimated_pose(true_pose, errors, equipment, rng),
        length_m=kind.length_m,
        width_m=kind.width_m,
        height_m=kind.height_m,
        position_std_m=position_std_m(errors, equipment),
    )


def _piece(scenario: dict[str, Any], row: CloudRow) -> Chunk:
    points = decode(np.frombuffer(row.payload, np.uint8)).points
    upload = UploadConfig.model_validate(scenario["upload"])
    is_post = row.agent in {mount["id"] for mount in scenario["roadside_mounts"]}
    filters = upload.of("roadside" if is_post else "vehicle").filters
    return Chunk(
        frame=row.frame,
        sim_time_ns=_time_ns(scenario, row.frame),
        agent=row.agent,
        index=row.chunk,
        chunk_count=1,
        sensor_pose=np.array(row[5:11]),
        points=np.ascontiguousarray(points, np.float32),
        received_ns=0,
        ground_free="foreground" in filters,
        returns=len(points),
    )


def _time_ns(scenario: dict[str, Any], frame: int) -> int:
    return round(frame * float(scenario["frame_period_s"]) * 1e9)
