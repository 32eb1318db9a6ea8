"""What an agent puts on the bus of a frame: a tunnel's wall, with a tenth of the beams lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from perception.roadway import Roadway
from protocol.codec import decode
from protocol.geometry import SE3
from protocol.messages import Scan
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan, ScanPattern
from sensing.config import UploadConfig
from sensing.lidar import Sensed
from sensing.lidar_uplink import LidarContext, LidarUplink
from sensing.radio import RealRadio
from sensing.upload_policies import POLICIES
from sensing.upload_selection import Selector
from sensing.world_view import WorldView

PATTERN = ScanPattern(16, 900, 15.0, -25.0)
POSE = SE3.from_pose([0, 0, 3.0, 0, 0, 0])


class Wire:
    """A bus that keeps what is published."""

    def __init__(self) -> None:
        self.scans: list[Scan] = []

    def publish(self, topic: str, message: Any, **parts: str) -> int:
        assert topic == "scan"
        self.scans.append(message)
        return 0

    def wire_bytes(self) -> int:
        return 0


class Tunnel:
    """The same scan again and again: everything is 8 m away, a tenth of the beams is lost."""

    def scan(self, agent: str, view: WorldView, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        shape = (PATTERN.channels, PATTERN.columns)
        range_m = np.full(shape, 8.0, np.float32)
        range_m[np.random.default_rng(1).random(shape) < 0.1] = 0
        scan = RangeScan(PATTERN, range_m, np.zeros(shape, np.float32))
        return Sensed(scan, np.zeros(0, np.int64))

    def close(self) -> None:
        pass


def sent(road_map: RoadMap, **config: Any) -> Scan:
    """Returns what one frame puts on the bus."""
    upload = UploadConfig.model_validate({"max_error_m": 0.2, **config})
    chosen = upload.of("vehicle")
    selector = Selector(
        POLICIES[chosen.policy],
        chosen.filters,
        Roadway.of(road_map, margin_m=1.0),
        PATTERN,
        thin_m=0.0,
        stationary=False,
    )
    wire = Wire()
    context = LidarContext(
        "vehicle-0",
        lockstep=True,
        period_ns=10**8,
        seed=1,
        source=Tunnel(),
        config=upload,
        detector_of=None,
    )
    uplink = LidarUplink("a", wire, RealRadio(wire), context, lambda _: selector)
    uplink.enter(["r"])
    view = WorldView(
        frame=0,
        sim_time_ns=0,
        ids=["a"],
        types=["car"],
        poses=np.zeros((1, 6)),
        speeds_mps=np.zeros(1, np.float32),
        hosted={},
    )
    uplink.sense_and_send(view, POSE, POSE, 0)
    (scan,) = wire.scans
    return scan


def test_a_whole_scan_holds_the_beams_that_returned(road_map: RoadMap) -> None:
    scan = sent(road_map)
    assert scan.points == len(decode(scan.payload).points)


@pytest.mark.parametrize("filters", [["roi"], ["foreground"]])
def test_what_a_filter_leaves_out_stays_out(road_map: RoadMap, filters: list[str]) -> None:
    scan = sent(road_map, filters=filters)
    assert len(decode(scan.payload).points) == scan.points
