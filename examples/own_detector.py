"""A detector of one's own, a plain function, beside the built-in one on the same traffic.

    python examples/own_detector.py --duration 10

The function finds a vehicle wherever enough points stand over a square of the road. It is given
each frame's cloud on the edge; the edge removes duplicates, tracks, assigns lanes and counts.
"""

from __future__ import annotations

import argparse

import numpy as np

import cpnet
from perception.detector import Cloud

SQUARE_M, LEAST_POINTS = 4.0, 8
SIZE_M = 4.5, 1.8, 1.5  # of every box


def squares(cloud: Cloud) -> np.ndarray:
    """Returns boxes (N, 8): x, y, z, length, width, height in m, yaw in rad, score; map frame."""
    points, over_road_m = cloud.points_over_road()  # (P, 3) and (P,); `cloud.bare` may be empty
    standing = points[(over_road_m > 0.3) & (over_road_m < 2.5)].astype(np.float64)
    if not len(standing):
        return np.zeros((0, 8))
    keys = np.floor(standing[:, :2] / SQUARE_M)
    _, square, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    square = square.reshape(-1)
    middle = np.stack([np.bincount(square, axis) for axis in standing.T], axis=-1) / count[:, None]
    full = count >= LEAST_POINTS
    boxes = np.column_stack([middle[full], np.tile(SIZE_M, (full.sum(), 1))])
    return np.column_stack([boxes, np.zeros(full.sum()), 1 - 1 / count[full]])


def main() -> None:
    """Prints what each detector found, frame by frame for the own one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=10.0, help="simulated seconds")
    parser.add_argument("--channels", type=int, default=64, help="layers of every LiDAR")
    options = parser.parse_args()
    lidar = {"channels": options.channels}
    scenario = {
        "duration_s": options.duration,
        "frame_period_s": 0.5,
        "traffic": {"cav_rate": 0.1, "warmup_s": 30},
        "lidar": {"vehicle": lidar, "roadside": lidar},
    }
    for frame in cpnet.simulate(scenario, detector=squares):
        print(
            f"{frame.sim_time_s:6.1f} s  {len(frame.boxes):3} boxes  {frame.upload_bytes:8} bytes"
        )
    for name, detector in {"squares": squares, "fast": None}.items():
        run = cpnet.run(scenario, detector=detector)
        seen, wrong = run.figures["e_cvpr"], run.figures["false_detections"]
        print(f"{name:8} E-CVPR {100 * seen:5.1f} %  {wrong:5.1f} false detections a frame")


if __name__ == "__main__":
    main()
