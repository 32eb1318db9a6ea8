"""Prints what detectors find in public scans.

`public_scans.py OUSTER_SDK POINTCLOUDSET FOLDER DETECTORS`. The first two are unpacked source
distributions of packages on PyPI, which have recordings among their tests: `ouster_sdk` 1.0.1 (BSD
3-clause; the package itself reads them) and `pointcloudset` 0.10.0 (a frame of KITTI's raw drive
2011_09_26_0002, CC BY-NC-SA 3.0). Vehicles were labelled by hand on pictures from above:
`public_scans/NAME.txt`, KITTI's labels in the frame of the sensor, DontCare what may be a vehicle
or not. FOLDER gets clouds and labels as `cpnet eval --kitti FOLDER` reads them.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path

import numpy as np
from ouster.sdk import core, open_source
from pyarrow import parquet

from edge_server.config import EdgeConfig
from learning.kitti_object import kitti_frames
from studies.kitti_eval import hits_of, judge

RECORDINGS = "sdk/tests"
SCENES = {
    "street-1": ("pcaps/OS-1-128_v2.3.0_1024x10_lb_n3.pcap", 0),
    "street-2": ("pcaps/OS-2-128-U1_v2.3.0_1024x10.pcap", 0),
    "street-3": ("pcaps/OS-0-128-U1_v2.3.0_1024x10.pcap", 0),
    "street-4": ("pcaps/OS-1-32-G_v2.1.1_1024x10.pcap", 0),
    "street-5": ("pcaps/OS-2-32-U0_v2.0.0_1024x10.pcap", 0),
    "street-6": ("osfs/single_scan_016.osf", 0),
    "car-park-1": ("osfs/pose_delta_2_128.osf", 0),
    "car-park-2": ("osfs/pose_delta_2_128.osf", 1),
}
"""By name: the recording, of which the first frame is taken, and which of its sensors."""
KITTI = "tests/testdata/kitti_velodyne/kitti_2011_09_26_drive_0002_synced/part.0.parquet"
KITTI_SCENE = "kitti-0002"
LABELS = Path(__file__).with_suffix("")
LOWER_SCORE = 0.3
"""A second row of learned detectors counts boxes from this score on."""
RANGE_M = 50.0


def main() -> None:
    """Prints JSON: a row for each scene, detector and score."""
    ouster, kitti, folder = (Path(word) for word in sys.argv[1:4])
    write_frames(ouster / RECORDINGS, folder)
    write_kitti(kitti / KITTI, folder)
    json.dump(rows_of(folder, sys.argv[4].split(","), EdgeConfig()), sys.stdout)


def rows_of(folder: Path, detectors: Sequence[str], config: EdgeConfig) -> list[dict[str, object]]:
    """Returns a row for each frame of a folder, detector and score."""
    rows: list[dict[str, object]] = []
    for frame in kitti_frames(folder):
        for detector, one in judge(frame, detectors, config, RANGE_M).items():
            labels = {"scene": frame.name, "detector": detector}
            for score in dict.fromkeys((one.least_score, min(one.least_score, LOWER_SCORE))):
                hits = hits_of(replace(one, least_score=score), RANGE_M)
                rows.append({**labels, "score": score, **asdict(hits)})
    return rows


def write_frames(recordings: Path, folder: Path) -> None:
    """Writes clouds and labels in KITTI's layout."""
    for part in ("velodyne", "label_2"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for name, (recording, sensor) in SCENES.items():
        cloud = points_of(recordings / recording, sensor)
        np.save(folder / "velodyne" / f"{name}.npy", cloud)
        shutil.copy(LABELS / f"{name}.txt", folder / "label_2")


def write_kitti(table: Path, folder: Path) -> None:
    """Adds a frame of KITTI, which the package has as Parquet."""
    columns = parquet.read_table(table)
    cloud = np.column_stack([columns[name].to_numpy() for name in ("x", "y", "z", "i")])
    np.save(folder / "velodyne" / f"{KITTI_SCENE}.npy", cloud.astype(np.float32))
    shutil.copy(LABELS / f"{KITTI_SCENE}.txt", folder / "label_2")


def points_of(recording: Path, sensor: int) -> np.ndarray:
    """Returns x, y, z and intensity (N, 4) of a recording's first frame, in the sensor's frame.

    A frame in which a sensor is missing is passed over.
    """
    for frame in islice(open_source(str(recording)), 3):
        scans = [scan for scan in frame if scan is not None]
        if len(scans) > sensor:
            scan = scans[sensor]
            hit = scan.field(core.ChanField.RANGE) > 0
            xyz = core.XYZLut(scan.sensor_info)(scan)[hit]
            reflectivity = scan.field(core.ChanField.REFLECTIVITY)[hit] / 255.0
            return np.column_stack([xyz, reflectivity]).astype(np.float32)
    raise SystemExit(f"{recording}: has no frame of {sensor + 1} sensors")


if __name__ == "__main__":
    main()
