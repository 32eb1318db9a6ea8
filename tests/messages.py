"""An example of every message, with as little in it as it needs."""

import numpy as np

from protocol import messages as m
from tests.roads import ONE_LANE


def tracked(number: int) -> dict[str, np.ndarray]:
    """Returns the track fields of `Detections` for so many boxes."""
    column = np.full(number, 0.5, np.float32)
    return {
        "track_ids": np.arange(1, number + 1),
        "speeds_mps": column,
        "coasted_s": np.zeros(number, np.float32),
        "ages_s": column,
        "position_std_m": column,
        "speed_std_mps": column,
    }


def no_tracks() -> dict[str, np.ndarray]:
    """Returns the track fields of `BorderObjects` without tracks."""
    empty = np.zeros(0, np.float32)
    return {
        "track_ids": np.zeros(0, np.int64),
        "track_boxes": np.zeros((0, 7), np.float32),
        "track_classes": np.zeros(0, np.uint8),
        "track_speeds_mps": empty,
        "track_coasted_s": empty,
        "track_ages_s": empty,
    }


SCAN = m.Scan(
    frame=7,
    sim_time_ns=700_000_000,
    agent="rsu-0",
    chunk=0,
    chunks=1,
    points=3,
    sensor_pose=np.arange(6.0),
    sense_start_ns=1,
    sense_end_ns=2,
    encode_end_ns=3,
    payload=np.arange(5, dtype=np.uint8),
)
EXAMPLES: list[m.Message] = [
    m.Setup(
        scenario={"seed": 1},
        road_map=ONE_LANE,
        vehicle_types=[
            m.VehicleType(name="car", mesh="car", length_m=4.5, width_m=1.8, height_m=1.5)
        ],
        meshes=[m.MeshPart(name="car", vertices=3, triangles=1)],
        mesh_vertices=np.eye(3, dtype=np.float32),
        mesh_triangles=np.array([[0, 1, 2]], np.int32),
        mesh_materials=np.array([m.Material.PAINT], np.uint8),
        parked_types=["car"],
        parked_poses=np.arange(6.0).reshape(1, 6),
        version="0.1.0",
    ),
    m.Tick(
        frame=1,
        sim_time_ns=100_000_000,
        processes=["vehicle-0"],
        bodies=3,
        agents=["a", "b"],
        equipment=np.array([1, 2], np.uint8),
        hosts=np.array([-1, 0], np.int32),
        places=np.arange(4.0).reshape(2, 2),
        tiles=np.array([[0, -1]], np.int32),
        since=np.array([1]),
    ),
    m.Truth(
        frame=1,
        sim_time_ns=100_000_000,
        ids=["a"],
        types=["car"],
        lanes=["in_0"],
        poses=np.zeros((1, 6)),
        speeds_mps=np.zeros(1, np.float32),
        lane_positions_m=np.ones(1, np.float32),
        equipment=np.zeros(1, np.uint8),
    ),
    m.Trips(
        frame=3,
        trips=[
            m.Trip(
                vehicle="a",
                equipment=m.Equipment.CV,
                depart_s=1.0,
                arrive_s=None,
                time_loss_s=2.5,
                stops=2,
                co2_g=120.5,
            )
        ],
    ),
    m.End(frames=600, reason="finished"),
    m.SignalState(
        frame=1,
        sim_time_ns=1,
        tls="J",
        state="G",
        stage="green",
        green="G",
        source="plan",
        earliest_change_ns=5,
    ),
    m.SignalRequest(
        frame=1,
        sim_time_ns=1,
        tls="J",
        state="G",
        policy="max_pressure",
        pressures=[3],
        unknown=["in_0"],
    ),
    m.Roster(frame=1, process="vehicle-0", agents=["a"], scanning=[]),
    m.AgentPose(
        frame=1,
        sim_time_ns=1,
        agent="a",
        equipment=m.Equipment.CAV,
        pose=np.zeros(6),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    ),
    SCAN,
    m.Detections(
        frame=1,
        sim_time_ns=1,
        agents=["a"],
        boxes=np.ones((1, 7), np.float32),
        scores=np.ones(1, np.float32),
        classes=np.zeros(1, np.uint8),
        lanes=["in_0"],
        distances_m=np.ones(1, np.float32),
        sources=["lidar"],
        **tracked(1),
    ),
    m.LaneCounts(
        frame=1,
        sim_time_ns=1,
        tls="J",
        agents=["a"],
        complete=True,
        upstream={"in_0": 2},
        downstream={"out_0": 0},
    ),
    m.Metrics(
        process="edge-r0",
        frame=1,
        sim_time_ns=1,
        spans=[m.Span(stage="merge", start_ns=1, end_ns=2)],
        arrivals=[m.Arrival(agent="a", chunk=0, received_ns=1, decoded_ns=2)],
        scores=[m.AgentScore(agent="a", score=0.35, trusted=False, motion=0, place=1, ground=None)],
        alignments=[
            m.AgentAlignment(
                agent="a",
                x_m=0.5,
                y_m=-0.25,
                z_m=0.125,
                yaw_rad=0.0625,
                std_m=0.03125,
                points=600,
                inliers=0.875,
                excluded=False,
            )
        ],
    ),
    m.Progress(
        frame=1,
        sim_time_ns=1,
        real_time_factor=1.5,
        vehicles=2,
        cavs=1,
        cvs=0,
        detections=2,
        mbps={"a": 5.0},
        end_to_end_ms=60,
        state="G",
        drops=0,
        regions={
            "r0": m.RegionProgress(
                agents=1, detections=2, frames=3, incomplete=1, mbps=5, end_to_end_ms=60
            )
        },
        junctions={
            "J": m.JunctionProgress(
                region="r0", phase=0, unchanged_s=1.5, vehicles=2, queued=1, coverage=0.5
            )
        },
    ),
    m.Plan(
        frame=2,
        agent="a",
        mbps=5.0,
        enough=1,
        agents=["a", "b"],
        sites=np.arange(4.0).reshape(2, 2),
        weights_m2=np.arange(6.0).reshape(2, 3),
    ),
    m.Objects(
        frame=1,
        sim_time_ns=1,
        agent="a",
        boxes=np.ones((1, 7), np.float32),
        scores=np.ones(1, np.float32),
        classes=np.zeros(1, np.uint8),
        sense_start_ns=1,
        sense_end_ns=2,
        detect_end_ns=3,
    ),
    m.TimeReply(machine="here", received_ns=5, replied_ns=6),
    m.ClockReading(process="edge-r0", offset_ns=-7, error_ns=8),
    m.Sighting(frame=2, agent="a", vehicles=["b"], points=np.array([7], np.int32)),
    m.BorderObjects(
        frame=1,
        sim_time_ns=1,
        boxes=np.ones((1, 7), np.float32),
        scores=np.ones(1, np.float32),
        classes=np.zeros(1, np.uint8),
        sources=["lidar"],
        position_std_m=np.zeros(1, np.float32),
        sensors=np.ones((1, 2)),
        track_sim_time_ns=1,
        track_ids=np.ones(1, np.int64),
        track_boxes=np.ones((1, 7), np.float32),
        track_classes=np.zeros(1, np.uint8),
        track_speeds_mps=np.ones(1, np.float32),
        track_coasted_s=np.zeros(1, np.float32),
        track_ages_s=np.ones(1, np.float32),
    ),
    m.TileBodies(
        frame=1,
        column=0,
        row=-1,
        ids=["a", "b"],
        types=["car", "car"],
        poses=np.arange(12.0).reshape(2, 6),
        speeds_mps=np.array([1, 2], np.float32),
    ),
    m.TileRequest(tiles=np.array([[0, -1], [3, 2]], np.int32)),
    m.SpeedAdvice(frame=1, sim_time_ns=1, tls="J", agent="a", speed_mps=8.5),
]


def lane_counts(frame: int) -> m.LaneCounts:
    """Returns the counts of no lane, which end a frame."""
    return m.LaneCounts(
        frame=frame,
        sim_time_ns=frame,
        tls="J",
        agents=[],
        complete=True,
        upstream={},
        downstream={},
    )


def tick_of(frame: int, sim_time_ns: int = 0, **changes: object) -> m.Tick:
    """Returns a tick of a world without bodies or agents but for what is given."""
    nothing: dict[str, object] = {
        "processes": [],
        "bodies": 0,
        "agents": [],
        "equipment": np.zeros(0, np.uint8),
        "hosts": np.zeros(0, np.int32),
        "places": np.zeros((0, 2)),
        "tiles": np.zeros((0, 2), np.int32),
        "since": np.zeros(0, np.int64),
    }
    return m.Tick.model_validate(nothing | {"frame": frame, "sim_time_ns": sim_time_ns} | changes)
