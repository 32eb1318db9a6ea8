"""A run with perception as a case of a control study: its delays, and its detections."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from protocol.config import is_file
from protocol.messages import is_bystander
from recording.run import Run
from studies.approach_log import ApproachLog, VehicleSample
from studies.control_run import delays_s, stops_and_co2
from studies.control_study import Row, file_digest, files_of_net
from studies.frame_rows import truth_by_frame
from studies.in_process import run_in_process
from studies.page.model import MapChart
from studies.run_sections import map_section
from studies.sumo_config import write_config
from studies.sweep.cells import Scenario, identify
from studies.sweep.worker import measure
from studies.uplink import scan_kilobytes

_OWN_CODE = (
    "perceived_case.py",
    "control_run.py",
    "sumo_config.py",
    "approach_log.py",
    "frame_rows.py",
    "uplink.py",
)


@dataclass(frozen=True, slots=True)
class PerceivedCase:
    """A run with perception; `draws` keeps where vehicles were seen and missed."""

    title: str
    scenario: Scenario
    draws: bool

    def identity(self) -> dict[str, Any]:
        """See `studies.control_study.Case`."""
        own = [Path(__file__).parent / name for name in _OWN_CODE]
        return {
            "run": identify(self.scenario),
            "files": [
                file_digest(one) for one in files_of_net(_config_of(self.scenario)) if is_file(one)
            ],
            "code": [file_digest(one) for one in own],
            "draws": self.draws,
        }


def _config_of(scenario: Scenario) -> Path:
    return Path(scenario["traffic"]["sumocfg"])


def run_perceived(case: PerceivedCase) -> Row:
    """Runs a scenario with perception in this process; returns its figures.

    Raises:
        ConfigError: the scenario cannot be run.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-compare-") as name:
        folder = Path(name)
        config, trips, run_dir = folder / "world.sumocfg", folder / "trips.xml", folder / "run"
        write_config(_config_of(case.scenario), config, trips)
        run_dir.mkdir()
        traffic = {**case.scenario["traffic"], "sumocfg": str(config)}
        run_in_process({**case.scenario, "traffic": traffic}, run_dir)
        with Run(run_dir) as run:
            ((first_ns,),) = run.query("SELECT min(sim_time_ns) FROM frames")
            log = _log_of(run, first_ns)
            scan = scan_kilobytes(run)
            found = {**measure(run_dir).row, **log.as_json()}
            found |= {"scan_kb": scan["mean"], "scan_peak_kb": scan["peak"]}
            found["waited_s"] = log.waited_s
            if case.draws:
                found["map"] = _map_points(run)
        delays, arrived = delays_s(trips, first_ns / 1e9)
        stops, co2_g = stops_and_co2(trips, first_ns / 1e9)
    return {
        **found,
        "stops": stops,
        "co2_g": co2_g,
        "delay_s": mean(delays) if delays else 0.0,
        "delay_p95_s": float(np.quantile(delays, 0.95)) if delays else 0.0,
        "vehicles": len(delays),
        "arrived": arrived,
    }


def _log_of(run: Run, first_ns: int) -> ApproachLog:
    log = ApproachLog(run.setup.road_map, float(run.scenario["frame_period_s"]))
    times_ns = dict(run.query("SELECT frame, sim_time_ns FROM frames"))
    for frame, bodies in truth_by_frame(run):
        samples = (
            VehicleSample(row.vehicle, row.lane, row.lane_position_m, row.speed_mps)
            for row in bodies
            if not is_bystander(row.vehicle)
        )
        log.note(((times_ns[frame] or first_ns) - first_ns) / 1e9, samples)
    return log


def _map_points(run: Run) -> list[dict[str, Any]]:
    """Returns the points of the map of a run, as `Points` has them."""
    charts = [block for block in map_section(run).blocks if isinstance(block, MapChart)]
    found: list[dict[str, Any]] = json.loads(
        json.dumps([asdict(p) for c in charts for p in c.points])
    )
    return found
