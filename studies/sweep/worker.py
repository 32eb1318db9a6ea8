"""The work of one cell on a worker: run the scenario in this process, measure it, clean up."""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from protocol.errors import ConfigError
from recording.run import Run
from studies.by_region import Figures, junctions_of_run, regions_of_run
from studies.count_error import count_errors
from studies.ecvpr import FrameScore, score
from studies.in_process import run_in_process
from studies.summary import pace_of, traffic_of
from studies.uplink import total_mbps, wire_mbps

Value = float | int | str | list[int] | None
Row = dict[str, Value]
Rows = dict[str, Row]

HISTOGRAM_BINS = 20  # of E-CVPR, from 0 to 1


@dataclass(frozen=True, slots=True)
class Measured:
    """A run's figures: of the whole, and by junction and region, each by its id."""

    row: Row
    junctions: Rows
    regions: Rows


def measure(run_dir: Path) -> Measured:
    """Returns a finished run's figures; one that the run does not yield is None.

    Shares are 0 to 1, delays in s over all journeys, uplink rates in Mbit/s of all agents together.
    `e_cvpr_hist` counts the frames by E-CVPR, in `HISTOGRAM_BINS` bins. Junctions name their
    region.

    Raises:
        ConfigError: the folder is no whole run.
    """
    with Run(run_dir) as run:
        scores = score(run)
        period_s = float(run.scenario["frame_period_s"])
        uplink, wire = total_mbps(run, period_s), wire_mbps(run, period_s)
        by_signal = count_errors(run)
        errors = np.concatenate([*by_signal.values(), []])
        duration_s = pace_of(run)["sim_duration_s"]
        row: Row = {
            "frames": len(scores),
            **_perception(scores),
            "count_error": _mean(np.abs(errors)),
            "count_bias": _mean(errors),
            **_traffic(run),
            "uplink_mbps": uplink["mean"],
            "uplink_peak_mbps": uplink["peak"],
            "wire_up_mbps": wire["up"],
            "wire_down_mbps": wire["down"],
        }
        junctions = junctions_of_run(run, scores, by_signal, duration_s)
        return Measured(row, _with_regions(run, junctions), _regions(run, duration_s))


def _with_regions(run: Run, junctions: Figures) -> Rows:
    members: dict[str, list[str]] = run.scenario["regions"]
    region_of = {tls: region for region, signals in members.items() for tls in signals}
    return {tls: {"region": region_of.get(tls), **found} for tls, found in junctions.items()}


def _regions(run: Run, duration_s: float) -> Rows:
    """Returns the figures by region that do not depend on a worker's speed: no latency."""
    return {
        region: {name: found[name] for name in ("agents", "mbps", "handovers")}
        for region, found in regions_of_run(run, duration_s).items()
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
        "delay_p95_s": found["delay_s"]["p95"],
        "stops": found["stops"],
        "co2_g": found["co2_g"],
        "switches": found["phases"]["switches"],
        **{f"vehicles_{name}": number for name, number in found["vehicles"].items()},
    }


def _mean(values: object) -> float | None:
    known = [value for value in np.asarray(values, object).ravel() if value is not None]
    return float(np.mean(known)) if known else None


_ONE_AT_A_TIME = threading.Lock()  # SUMO keeps its state globally, whatever the worker's threads


@dataclass(frozen=True, slots=True)
class Task:
    """The input of a worker: one run."""

    scenario: dict[str, Any]
    version: str
    run_dir: str | None = None
    """A new folder for the run; None: the run is deleted once measured."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a worker."""

    row: Row
    took_s: float
    junctions: Rows = field(default_factory=dict)
    regions: Rows = field(default_factory=dict)


def run_cell(task: Task) -> Outcome:
    """Runs and measures one scenario.

    Raises:
        ConfigError: the scenario cannot be run, or this is another version.
    """
    here = version("cpnet-edge")
    if here != task.version:
        raise ConfigError(f"this worker has cpnet {here}, the study is of {task.version}")
    with _ONE_AT_A_TIME, in_own_folder() as folder:
        begun_ns = time.monotonic_ns()
        run_dir = Path(folder) / "run"
        run_dir.mkdir()
        run_in_process(task.scenario, run_dir)
        found = measure(run_dir)
        took_s = (time.monotonic_ns() - begun_ns) / 1e9
        if task.run_dir is not None:
            shutil.copytree(run_dir, task.run_dir, dirs_exist_ok=True)
    return Outcome(found.row, took_s, found.junctions, found.regions)


def in_own_folder() -> tempfile.TemporaryDirectory[str]:
    """Returns a folder for one run within the worker's own: Dask deletes a killed worker's too."""
    from distributed import get_worker

    try:
        within = get_worker().local_directory
    except ValueError:  # no worker does this
        within = None
    return tempfile.TemporaryDirectory(prefix="cell-", dir=within)
