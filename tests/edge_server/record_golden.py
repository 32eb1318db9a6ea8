"""Makes the golden replay from a run: `python -m tests.edge_server.record_golden RUN`.

Only to be run when a change of the results is meant; the change of the expected file then
shows in review what it did.
"""

import json
import sys
from pathlib import Path

import numpy as np

from protocol.messages import Scan, Setup
from protocol.wire import encode
from recording.run import Run
from recording.tables import CloudRow
from tests.edge_server.golden_scans import EXPECTED, SCANS, SETUP, replay

FRAMES = 2


def main(run_dir: Path) -> None:
    """Writes the set-up, the scans of the last recorded frames and what comes of them."""
    with Run(run_dir) as run:
        clouds, setup = list(run.rows(CloudRow)), run.setup
    bare = {"vehicle_types": [], "meshes": [], "mesh_vertices": np.zeros((0, 3), np.float32)}
    bare["mesh_triangles"] = np.zeros((0, 3), np.int32)
    SETUP.write_bytes(encode(Setup(scenario=setup.scenario, road_map=setup.road_map, **bare)))
    frames = sorted({cloud.frame for cloud in clouds})[-FRAMES:]
    scans = b""
    for cloud in (c for c in clouds if c.frame in frames):
        data = encode(scan_of(cloud))
        scans += len(data).to_bytes(4, "little") + data
    SCANS.write_bytes(scans)
    EXPECTED.write_text(json.dumps(replay(), indent=1) + "\n")


def scan_of(cloud: CloudRow) -> Scan:
    """Returns the message that a recorded cloud came in."""
    position = [cloud.sensor_x_m, cloud.sensor_y_m, cloud.sensor_z_m]
    angles = [cloud.sensor_roll_rad, cloud.sensor_pitch_rad, cloud.sensor_yaw_rad]
    return Scan(
        frame=cloud.frame,
        sim_time_ns=0,
        agent=cloud.agent,
        chunk=cloud.chunk,
        chunks=1,
        points=cloud.points,
        sensor_pose=np.array(position + angles),
        sense_start_ns=0,
        sense_end_ns=0,
        encode_end_ns=0,
        payload=np.frombuffer(cloud.payload, np.uint8),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
