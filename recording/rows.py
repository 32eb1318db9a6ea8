"""Messages as rows; the lists of a message are equally long, or it would not have come."""

from __future__ import annotations

import json
from collections.abc import Iterator

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


def detection_rows(message: Detections) -> Iterator[DetectionRow]:
    """Returns a row per box, numbered as in the message."""
    boxes = message.boxes.astype(float).tolist()
    scores, distances = message.scores.tolist(), message.distances_m.tolist()
    columns = zip(boxes, scores, message.lanes, distances, message.sources, strict=True)
    return (
        DetectionRow._make((message.frame, index, *box, score, lane, distance_m, source))
        for index, (box, score, lane, distance_m, source) in enumerate(columns)
    )


def count_rows(message: LaneCounts) -> Iterator[CountRow]:
    """Returns a row per lane and side of the stop bar."""
    sides = {
        "upstream": (message.upstream, message.stationary_upstream),
        "downstream": (message.downstream, message.stationary_downstream),
    }
    return (
        CountRow(message.frame, lane, side, vehicles, queued.get(lane, 0))
        for side, (lanes, queued) in sides.items()
        for lane, vehicles in lanes.items()
    )


def phase_row(message: SignalState) -> PhaseRow:
    """Returns the signal's state in a frame."""
    m = message
    return PhaseRow(m.frame, m.tls, m.sim_time_ns, m.state, m.stage, m.green, m.source)


def request_row(message: SignalRequest) -> RequestRow:
    """Returns a policy's wish in a frame."""
    pressures = json.dumps(message.pressures)
    m = message
    unknown = " ".join(m.unknown)
    return RequestRow(m.frame, m.tls, m.state, m.policy, pressures, m.delay_sim_ns, unknown)


def truth_rows(message: Truth) -> Iterator[TruthRow]:
    """Returns a row per vehicle."""
    poses, equipment = message.poses.tolist(), message.equipment.tolist()
    speeds, positions = message.speeds_mps.tolist(), message.lane_positions_m.tolist()
    columns = (message.ids, message.types, equipment, poses, speeds, message.lanes, positions)
    return (
        TruthRow._make((message.frame, vehicle, kind, carries, *pose, speed_mps, lane, position_m))
        for vehicle, kind, carries, pose, speed_mps, lane, position_m in zip(*columns, strict=True)
    )


def sighting_row(message: Sighting) -> SightingRow:
    """Returns what one agent's scan had of which vehicles."""
    points = dict(zip(message.vehicles, message.points.tolist(), strict=True))
    return SightingRow(message.frame, message.agent, json.dumps(points))


def trip_rows(message: Trips) -> Iterator[TripRow]:
    """Returns a row per journey."""
    return (
        TripRow(
            trip.vehicle,
            int(trip.equipment),
            trip.depart_s,
            trip.arrive_s,
            trip.time_loss_s,
            int(trip.teleported),
        )
        for trip in message.trips
    )


def stage_rows(message: Metrics) -> Iterator[StageRow]:
    """Returns a row per span."""
    return (
        StageRow(
            message.frame,
            message.process,
            span.agent,
            span.stage,
            span.start_ns,
            span.end_ns - span.start_ns,
        )
        for span in message.spans
    )


def agent_score_rows(message: Metrics) -> Iterator[AgentScoreRow]:
    """Returns a row per agent that the edge told of."""
    return (
        AgentScoreRow(
            message.frame,
            one.agent,
            one.score,
            int(one.trusted),
            one.motion,
            one.place,
            one.ground,
        )
        for one in message.scores
    )


def cloud_row(message: Scan) -> CloudRow:
    """Returns an upload as it went over the bus."""
    pose = message.sensor_pose.tolist()
    payload = message.payload.tobytes()
    return CloudRow._make(
        (message.frame, message.agent, message.chunk, message.points, *pose, payload)
    )
