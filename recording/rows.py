"""Messages as rows; the lists of a message are equally long, or it would not have come."""

from __future__ import annotations

import json
from collections.abc import Iterator

from protocol.instances import region_of
from protocol.messages import (
    Detections,
    LaneCounts,
    Metrics,
    Scan,
    Sighting,
    SignalRequest,
    SignalState,
    Trips,
    Truth,
)
from recording.tables import (
    AgentScoreRow,
    CloudRow,
    CountRow,
    DetectionRow,
    PhaseRow,
    RequestRow,
    SightingRow,
    StageRow,
    TripRow,
    TruthRow,
)


def detection_rows(message: Detections, region: str) -> Iterator[DetectionRow]:
    """Returns a row per box of a region's edge, numbered as in the message."""
    boxes = message.boxes.astype(float).tolist()
    scores, distances = message.scores.tolist(), message.distances_m.tolist()
    columns = zip(boxes, scores, message.lanes, distances, message.sources, strict=True)
    return (
        DetectionRow(
            frame=message.frame,
            region=region,
            detection=index,
            x_m=x,
            y_m=y,
            z_m=z,
            length_m=length,
            width_m=width,
            height_m=height,
            yaw_rad=yaw,
            score=score,
            lane=lane,
            distance_m=distance_m,
            source=source,
        )
        for index, (box, score, lane, distance_m, source) in enumerate(columns)
        for x, y, z, length, width, height, yaw in [box]
    )


def count_rows(message: LaneCounts) -> Iterator[CountRow]:
    """Returns a row per lane and side of the stop bar."""
    sides = {
        "upstream": (message.upstream, message.stationary_upstream),
        "downstream": (message.downstream, message.stationary_downstream),
    }
    return (
        CountRow(message.frame, message.tls, lane, side, vehicles, queued.get(lane, 0))
        for side, (lanes, queued) in sides.items()
        for lane, vehicles in lanes.items()
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
    """Returns a policy's wish in a frame."""
    return RequestRow(
        frame=message.frame,
        tls=message.tls,
        state=message.state,
        policy=message.policy,
        pressures=json.dumps(message.pressures),
        delay_sim_ns=message.delay_sim_ns,
        unknown=" ".join(message.unknown),
    )


def truth_rows(message: Truth) -> Iterator[TruthRow]:
    """Returns a row per vehicle."""
    poses, equipment = message.poses.tolist(), message.equipment.tolist()
    speeds, positions = message.speeds_mps.tolist(), message.lane_positions_m.tolist()
    columns = (message.ids, message.types, equipment, poses, speeds, message.lanes, positions)
    return (
        TruthRow(
            frame=message.frame,
            vehicle=vehicle,
            type=kind,
            equipment=carries,
            x_m=x,
            y_m=y,
            z_m=z,
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=yaw,
            speed_mps=speed_mps,
            lane=lane,
            lane_position_m=position_m,
        )
        for vehicle, kind, carries, pose, speed_mps, lane, position_m in zip(*columns, strict=True)
        for x, y, z, roll, pitch, yaw in [pose]
    )


def sighting_row(message: Sighting) -> SightingRow:
    """Returns what one agent's scan had of which vehicles."""
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
    """Returns a row per agent that an edge told of."""
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
