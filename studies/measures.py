"""What a study keeps of a run: one flat row, in which nothing depends on the clock on the wall."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recorder.run import Run
from studies.bandwidth import total_mbps
from studies.count_error import lane_errors
from studies.ecvpr import FrameScore, score
from studies.summary import traffic_of

Value = float | int | str | list[int] | None
Row = dict[str, Value]

HISTOGRAM_BINS = 20  # of E-CVPR, from 0 to 1


def measure(run_dir: Path) -> Row:
    """Returns a finished run's figures; one that the run does not yield is None.

    Shares are 0 to 1, delays in s over all journeys, uplink rates in Mbit/s of all agents together.
    `e_cvpr_hist` counts the frames by E-CVPR, in `HISTOGRAM_BINS` bins.

    Raises:
        ConfigError: the folder is no whole run.
    """
    with Run(run_dir) as run:
        scores = score(run)
        uplink = total_mbps(run, float(run.scenario["frame_period_s"]))
        errors = lane_errors(run)
        return {
            "frames": len(scores),
            **_perception(scores),
            "count_error": _mean(np.abs(errors)),
            "count_bias": _mean(errors),
            **_traffic(run),
            "uplink_mbps": uplink["mean"],
            "uplink_peak_mbps": uplink["peak"],
        }


def _perception(scores: list[FrameScore]) -> Row:
    rates = np.array([s.e_cvpr for s in scores if s.e_cvpr is not None])
    counts, _ = np.histogram(rates, HISTOGRAM_BINS, (0.0, 1.0))
    return {
        "e_cvpr": _mean(rates),
        "e_cvpr_std": float(rates.std()) if len(rates) else None,
        "e_cvpr_hist": [int(n) for n in counts],
        "visible_share": _mean([s.visible_share for s in scores]),
        "in_range_share": _mean([s.in_range_share for s in scores]),
        "present": _mean([s.present for s in scores]),
        "false_detections": _mean([s.false for s in scores]),
    }


def _traffic(run: Run) -> Row:
    found = traffic_of(run)
    return {
        "delay_s": found["delay_s"]["mean"],
        "delay_std_s": found["delay_s"]["std"],
        "switches": found["phases"]["switches"],
        **{f"vehicles_{name}": number for name, number in found["vehicles"].items()},
    }


def _mean(values: object) -> float | None:
    known = [value for value in np.asarray(values, object).ravel() if value is not None]
    return float(np.mean(known)) if known else None
