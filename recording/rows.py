"""Converts messages to rows; a valid message's lists are equally long."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from itertools import count, repeat
from typing import Any, TypeVar

from protocol.instances import region_of
from protocol.messages import (
    Detections,
    LaneCounts,
    Metrics,
    Scan,
    Setup,
    Sighting,
    SignalRequest,
    SignalState,
    Trips,
    Truth,
)
from recording.tables import (
    TABLES,
    AgentScoreRow,
    AlignmentRow,
    CloudRow,
    CountRow,
    DetectionRow,
    ParkedRow,
    PhaseRow,
    RequestRow,
    SightingRow,
    StageRow,
    TripRow,
    TruthRow,
    VehicleTypeRow,
)

R = TypeVar("R", bound=tuple[Any, ...])


def _rows(row: type[R], **columns: Iterable[object]) -> Iterator[R]:
    """Returns rows from columns by name: thousands a frame, so that no Python runs for each."""
    table = TABLES[row]
    return map(table.row._make, zip(*(columns[name] for name in table.columns), strict=False))


def detection_rows(message: Detections, region: str) -> Iterator[DetectionRow]:
    """Returns a row per box of a region's edge, numbered as in the message."""
    x, y, z, length, width, height, yaw = message.boxes.T.astype(float).tolist()
    return _rows(
        DetectionRow,
        frame=repeat(message.frame),
        region=repeat(region),
        detection=count(),
        x_m=x,
        y_m=y,
        z_m=z,
        length_m=length,
        width_m=width,
        height_m=height,
        yaw_rad=yaw,
        score=message.scores.tolist(),
        object_class=message.classes.tolist(),
        lane=message.lanes,
        distance_m=message.distances_m.tolist(),
        source=message.sources,
        track=message.track_ids.tolist(),
        speed_mps=message.speeds_mps.tolist(),
        coasted_s=message.coasted_s.tolist(),
        position_std_m=message.position_std_m.tolist(),
        speed_std_mps=message.speed_std_mps.tolist(),
    )


def count_rows(message: LaneCounts) -> Iterator[CountRow]:
    """Returns a row per lane and side of the stop bar."""
    sides = {
        "upstream": (message.upstream, message.stationary_upstream, message.coasted_upstream),
        "downstream": (
            message.downstream,
            message.stationary_downstream,
            message.coasted_downstream,
        ),
    }
    frame, tls = message.frame, message.tls
    return (
        CountRow(frame, tls, lane, side, number, queued.get(lane, 0), coasted.get(lane, 0))
        for side, (lanes, queued, coasted) in sides.items()
        for lane, number in lanes.items()
    )


def phase_row(message: SignalState) -> PhaseRow:
    """Returns the signal's state in a frame."""
    m = message
    return PhaseRow(
        frame=m.frame,
        tls=m.tls,
        sim_time_ns=m.sim_time_ns,
        state=m.state,
        stage=m.stage,
        green=m.green,
        source=m.source,
    )


def request_row(message: SignalRequest) -> RequestRow:
    """Returns a policy's request in a frame."""
    return RequestRow(
        frame=message.frame,
        tls=message.tls,
        state=message.state,
        policy=message.policy,
        pressures=json.dumps(message.pressures),
        delay_sim_ns=message.delay_sim_ns,
        unknown=" ".join(message.unknown),
        wait_sim_ns=max(0, message.not_before_ns - message.sim_time_ns),
    )


def truth_rows(message: Truth) -> Iterator[TruthRow]:
    """Returns a row per vehicle."""
    x, y, z, roll, pitch, yaw = message.poses.T.tolist()
    return _rows(
        TruthRow,
        frame=repeat(message.frame),
        vehicle=message.ids,
        type=message.types,
        equipment=message.equipment.tolist(),
        x_m=x,
        y_m=y,
        z_m=z,
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        speed_mps=message.speeds_mps.tolist(),
        lane=message.lanes,
        lane_position_m=message.lane_positions_m.tolist(),
    )


def vehicle_type_rows(setup: Setup) -> Iterator[VehicleTypeRow]:
    """Returns a row per type."""
    return (
        VehicleTypeRow(
            type=kind.name,
            object_class=int(kind.object_class),
            length_m=kind.length_m,
            width_m=kind.width_m,
            height_m=kind.height_m,
        )
        for kind in setup.vehicle_types
    )


def parked_rows(setup: Setup) -> Iterator[ParkedRow]:
    """Returns a row per parked car."""
    x, y, z, roll, pitch, yaw = setup.parked_poses.T.tolist()
    return _rows(
        ParkedRow,
        vehicle=setup.parked_ids,
        type=setup.parked_types,
        x_m=x,
        y_m=y,
        z_m=z,
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
    )


def sighting_row(message: Sighting) -> SightingRow:
    """Returns the number of an agent's points by vehicle."""
    points = dict(zip(message.vehicles, message.points.tolist(), strict=True))
    return SightingRow(message.frame, message.agent, json.dumps(points))


def trip_rows(message: Trips) -> Iterator[TripRow]:
    """Returns a row per journey."""
    return (
        TripRow(
            vehicle=trip.vehicle,
            equipment=int(trip.equipment),
            depart_s=trip.depart_s,
            arrive_s=trip.arrive_s,
            time_loss_s=trip.time_loss_s,
            teleported=int(trip.teleported),
            stops=trip.stops,
            co2_g=trip.co2_g,
        )
        for trip in message.trips
    )


def stage_rows(message: Metrics) -> Iterator[StageRow]:
    """Returns a row per span."""
    return (
        StageRow(
            frame=message.frame,
            process=message.process,
            agent=span.agent,
            stage=span.stage,
            start_ns=span.start_ns,
            duration_ns=span.end_ns - span.start_ns,
        )
        for span in message.spans
    )


def agent_score_rows(message: Metrics) -> Iterator[AgentScoreRow]:
    """Returns a row per agent with a score of an edge."""
    return (
        AgentScoreRow(
            frame=message.frame,
            region=region_of(message.process),
            agent=one.agent,
            score=one.score,
            trusted=int(one.trusted),
            motion=one.motion,
            place=one.place,
            ground=one.ground,
        )
        for one in message.scores
    )


def alignment_rows(message: Metrics) -> Iterator[AlignmentRow]:
    """Returns a row per agent whose scan an edge registered."""
    region = region_of(message.process)
    return (
        AlignmentRow(
            frame=message.frame,
            region=region,
            agent=one.agent,
            x_m=one.x_m,
            y_m=one.y_m,
            z_m=one.z_m,
            yaw_rad=one.yaw_rad,
            std_m=one.std_m,
            points=one.points,
            inliers=one.inliers,
            excluded=int(one.excluded),
        )
        for one in message.alignments
    )


def cloud_row(message: Scan, region: str) -> CloudRow:
    """Returns an upload to a region as it went over the bus."""
    x, y, z, roll, pitch, yaw = message.sensor_pose.tolist()
    return CloudRow(
        frame=message.frame,
        region=region,
        agent=message.agent,
        chunk=message.chunk,
        points=message.points,
        sensor_x_m=x,
        sensor_y_m=y,
        sensor_z_m=z,
        sensor_roll_rad=roll,
        sensor_pitch_rad=pitch,
        sensor_yaw_rad=yaw,
        payload=message.payload.tobytes(),
    )
