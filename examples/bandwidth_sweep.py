"""How much uplink does perception need? Two upload policies over links of several rates.

    python examples/bandwidth_sweep.py --duration 20 --out runs/sweep

Cells that are done in the folder `--out` are not run again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import polars as pl

import cpnet


def sweep(links: list[str], duration_s: float, channels: int, out: Path | None) -> pl.DataFrame:
    """Returns a row for each policy and link, with what was seen and what it cost.

    Roadside units have a link of their own, fast by default: here all agents have the same.
    """
    uplinks = {one: {"link.profile": one, "link.roadside_profile": one} for one in links}
    study = {
        "name": "sweep",
        "seeds": [1],
        "axes": {"upload.policy": ["full", "foreground"], "link": uplinks},
    }
    lidar = {"channels": channels}
    table = cpnet.study(
        study,
        out=out,
        duration_s=duration_s,
        traffic={"cav_rate": 0.1, "warmup_s": 30},
        lidar={"vehicle": lidar, "roadside": lidar},
    )
    return table.select(
        "upload.policy",
        "link",
        (100 * pl.col("e_cvpr")).round(1).alias("E-CVPR in %"),
        pl.col("uplink_mbps").round(2).alias("uplink in Mbit/s"),
        pl.col("count_error").round(2).alias("count error in vehicles"),
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--links", nargs="+", default=["1mbit,20ms", "3mbit,20ms", "10mbit,20ms"])
    parser.add_argument("--duration", type=float, default=20.0, help="simulated seconds")
    parser.add_argument("--channels", type=int, default=64, help="layers of every LiDAR")
    parser.add_argument("--out", type=Path, help="folder of results")
    options = parser.parse_args()
    with pl.Config(tbl_rows=-1, tbl_hide_dataframe_shape=True, tbl_width_chars=120):
        print(sweep(options.links, options.duration, options.channels, options.out))


if __name__ == "__main__":
    main()
