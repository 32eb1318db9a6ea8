"""Messages that viewers show."""

import numpy as np

from protocol import messages as m
from tests.messages import EXAMPLES, tick_of, tracked
from tests.roads import CROSSING

CAR = m.VehicleType(name="car", mesh="car", length_m=4.0, width_m=2.0, height_m=1.5)


def detections(**changes: object) -> m.Detections:
    plain = {
        "frame": 1, "sim_time_ns": 1, "agents": ["a"],
        "boxes": np.array([[0, -20, 1, 4, 2, 1.5, 0], [0, -60, 1, 4, 2, 1.5, 0]], np.float32),
        "scores": np.ones(2, np.float32), "classes": np.zeros(2, np.uint8),
        "lanes": ["south_0", ""],
        "distances_m": np.ones(2, np.float32), "sources": ["lidar", "a"],
    }  # fmt: skip
    made = plain | changes
    return m.Detections(**(tracked(len(made["boxes"])) | made))


def truth() -> m.Truth:
    return m.Truth(
        frame=1, sim_time_ns=1, ids=["v", "w"], types=["car", "tank"], lanes=["south_0", "west_0"],
        poses=np.array([[0, -20.3, 0, 0, 0, np.pi / 2], [-20, 0, 0, 0, 0, 0]]),
        speeds_mps=np.zeros(2, np.float32), lane_positions_m=np.full(2, 60, np.float32),
        equipment=np.zeros(2, np.uint8),
    )  # fmt: skip


PERIOD_NS = 100_000_000
MS = 1_000_000


def sent(frame: int, agent: str, payload_bytes: int) -> m.Metrics:
    upload = m.Upload(
        agent=agent, region="r0", chunk=0, points=1, payload_bytes=payload_bytes, sense_start_ns=0,
        sense_end_ns=1, encode_end_ns=2, sent_ns=3,
    )  # fmt: skip
    return m.Metrics(
        process="vehicle-0", frame=frame, sim_time_ns=frame * PERIOD_NS, uploads=[upload]
    )


def tick(frame: int) -> m.Tick:
    return tick_of(frame, frame * PERIOD_NS)


def measured(
    frame: int, process: str, *spans: tuple[str, str, int, int], **more: object
) -> m.Metrics:
    rows = [
        m.Span(stage=stage, agent=agent, start_ns=a * MS, end_ns=b * MS)
        for stage, agent, a, b in spans
    ]
    return m.Metrics(
        process=process, frame=frame, sim_time_ns=frame * PERIOD_NS, spans=rows, **more
    )


SETUP = next(e for e in EXAMPLES if isinstance(e, m.Setup)).model_copy(
    update={
        "road_map": CROSSING,
        "scenario": {
            "name": "crossing",
            "mode": "lockstep",
            "frame_period_s": 0.1,
            "regions": {"r0": ["J"]},
        },
    }
)
