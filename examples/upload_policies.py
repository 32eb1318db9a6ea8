"""Plays one scenario with two upload policies in this process and compares what they cost and see.

    python examples/upload_policies.py --duration 10

A study of many runs is better described in a file, see docs/studies.md; this is for what a study
cannot express: runs whose results decide what is run next, or figures of your own.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from cpnet import scenario as scenarios
from recording.run import Run
from recording.tables import UploadRow
from studies.in_process import run_in_process
from studies.sweep.worker import measure


def run_once(run_dir: Path, policy: str, duration_s: float, channels: int) -> dict[str, float]:
    """Returns E-CVPR in %, mean uplink of all agents in Mbit/s, and the largest chunk in kB."""
    run_dir.mkdir()
    scenario = scenarios.load(
        "t_junction",
        {
            "duration_s": duration_s,
            "seed": 1,
            "traffic.cav_rate": 0.05,
            "upload.policy": policy,
            "lidar.vehicle.channels": channels,
            "lidar.roadside.channels": channels,
        },
    )
    run_in_process(scenario.model_dump(mode="json"), run_dir)
    figures = measure(run_dir).row
    with Run(run_dir) as run:
        largest_bytes = max(upload.payload_bytes for upload in run.rows(UploadRow))
    return {
        "E-CVPR %": 100 * float(figures["e_cvpr"]),
        "Mbit/s": float(figures["uplink_mbps"]),
        "largest kB": largest_bytes / 1e3,
    }


def main() -> None:
    """Prints a line for each upload policy."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=10.0, help="simulated seconds")
    parser.add_argument("--channels", type=int, default=64, help="layers of every LiDAR")
    parser.add_argument("--policies", nargs="+", default=["full", "foreground"])
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        for policy in options.policies:
            figures = run_once(Path(folder) / policy, policy, options.duration, options.channels)
            print(f"{policy:12}", *(f"{name} {value:6.1f}" for name, value in figures.items()))


if __name__ == "__main__":
    main()
