"""The setup of a run on a straight road."""

from pathlib import Path

import numpy as np

from protocol.messages import Setup, VehicleType
from protocol.wire import encode
from recording.run import SETUP_NAME
from tests.roads import straight_road

CAR = VehicleType(name="car", mesh="car", length_m=4.0, width_m=2.0, height_m=1.5)


def write_setup(run_dir: Path) -> None:
    setup = Setup(
        scenario={"regions": {"r0": ["j"]}},
        road_map=straight_road(),
        vehicle_types=[CAR],
        meshes=[],
        mesh_vertices=np.zeros((0, 3)),
        mesh_triangles=np.zeros((0, 3)),
    )
    (run_dir / SETUP_NAME).write_bytes(encode(setup))
