"""Pictures are drawn whatever is missing from them."""

import numpy as np
import pytest

rr = pytest.importorskip("rerun", reason="the extra `view` is not installed")

from protocol import messages as m  # noqa: E402 - of use with the extra alone
from protocol.codec import encode_cloud  # noqa: E402 - what follows is of use with the extra alone
from protocol.scans import PointCloud  # noqa: E402
from tests.messages import SCAN, lane_counts  # noqa: E402
from tests.viewer.city import CITY_SETUP  # noqa: E402
from tests.viewer.shown import (  # noqa: E402
    CAR,
    SETUP,
    detections,
    truth,
)
from viewer.rerun_log import Log, blueprint  # noqa: E402
from viewer.scene import Moment, Scene  # noqa: E402
from viewer.stages import GROUPS, FrameLatency  # noqa: E402


@pytest.mark.parametrize("agents", [[], ["a"], ["a", "b/c d"]])
@pytest.mark.parametrize("setup", [SETUP, CITY_SETUP])
def test_a_frame_is_drawn_with_and_without_clouds(setup: m.Setup, agents: list[str]) -> None:
    scene = Scene(setup.model_copy(update={"vehicle_types": [CAR]}))
    recording = rr.RecordingStream("test")
    kept = recording.memory_recording()
    log = Log(recording, scene)
    cloud = PointCloud(np.ones((5, 3), np.float32), np.zeros(5, np.float32))
    payload = np.frombuffer(encode_cloud(cloud, 0.02), np.uint8)
    scans = [SCAN.model_copy(update={"payload": payload, "agent": agent}) for agent in agents]
    whole = Moment(1, scans=scans, detections=detections(), truth=truth())
    whole.add(lane_counts(1))
    for moment in (whole, Moment(2, detections=detections()), Moment(3, truth=truth())):
        picture = scene.picture(moment)
        assert picture is not None
        log.picture(picture)
    log.latency(FrameLatency(1, 1, dict.fromkeys(GROUPS, 1.0), 9.0))
    assert len(kept.drain_as_bytes()) > 1000
    assert scene.picture(Moment(4)) is None


@pytest.mark.parametrize("setup", [SETUP, CITY_SETUP])
def test_there_is_a_layout(setup: m.Setup) -> None:
    assert blueprint(Scene(setup)) is not None
