"""Recorded scans, and what the pipeline makes of them."""

from itertools import groupby
from pathlib import Path

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.frame import Frame
from edge_server.pipeline import Pipeline
from protocol.messages import Scan, Setup
from protocol.regions import RegionMap
from protocol.wire import decode

GOLDEN = Path(__file__).parent / "golden"


SETUP, SCANS, EXPECTED = (GOLDEN / name for name in ("setup.bin", "scans.bin", "expected.json"))


def recorded() -> list[Scan]:
    data, scans = SCANS.read_bytes(), []
    while data:
        size = int.from_bytes(data[:4], "little")
        scans.append(decode(data[4 : 4 + size], Scan))
        data = data[4 + size :]
    return scans


def replay() -> list[dict[str, object]]:
    """Returns what the pipeline makes of the recorded scans, frame by frame."""
    setup = decode(SETUP.read_bytes(), Setup)
    config = EdgeConfig.model_validate(setup.scenario["edge"])
    pipeline = Pipeline.of(RegionMap.whole(setup.road_map), config, seed=setup.scenario["seed"])
    results = []
    for number, scans in groupby(recorded(), key=lambda scan: scan.frame):
        chunks = [pipeline.open(scan, 0) for scan in scans]
        agents = [chunk.agent for chunk in chunks]
        time_ns = number * round(setup.scenario["frame_period_s"] * 1e9)
        frame = Frame(number, time_ns, agents, [], chunks, complete=True, first_ns=0, ready_ns=0)
        result = pipeline.run(frame)
        results.append(
            {
                "frame": number,
                "boxes": np.round(result.detections.boxes.astype(float), 2).tolist(),
                "lanes": result.detections.lanes,
                "upstream": result.counts["J"].upstream,
                "downstream": result.counts["J"].downstream,
            }
        )
    return results
