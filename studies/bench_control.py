"""`cpnet bench control`: signal policies on SUMO alone, with perfect positions near the signals.

No sensor, network or detector takes part: only the control is measured. Delay is what SUMO's
tripinfo calls time loss plus departure delay, of all vehicles, also those still under way at the
end and those that found no room to enter.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from protocol.errors import ConfigError
from studies.bench import empty_table, print_whole
from studies.control_baselines import OWN_SETTINGS
from studies.control_case import OWN_PLAN, WEBSTER, ControlCase
from studies.control_run import ControlRow, ControlRun
from studies.page.model import DASH
from studies.run_pool import run_each


def measure_control(cases: Sequence[ControlCase], processes: int = 1) -> Iterator[ControlRow]:
    """Yields the row of each case, in their order, from a process of its own.

    Raises:
        ConfigError: a net or a policy is invalid.
    """
    timed = [case for case in cases if case.policy == WEBSTER]
    flows = {timed[number]: found for number, found in run_each(lane_flows_vph, timed, processes)}
    whole = [replace(case, flows_vph=flows.get(case, {})) for case in cases]
    rows: dict[int, ControlRow] = {}
    following = 0
    for number, row in run_each(run_case, whole, processes):
        rows[number] = row
        while following in rows:
            yield rows.pop(following)
            following += 1


def lane_flows_vph(case: ControlCase) -> dict[str, float]:
    """Returns the vehicles per hour that pass each stop bar under the net's own plan.

    Raises:
        ConfigError: the net is invalid.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-control-") as folder:
        run = ControlRun(replace(case, policy=OWN_PLAN), Path(folder))
        run.row()
        return {lane: count * 3600 / case.duration_s for lane, count in run.passed.items()}


def run_case(case: ControlCase) -> ControlRow:
    """Runs a case; the first run of a process alone gives the same row every time.

    Raises:
        ConfigError: the net or the policy is invalid, or a setting is unknown to the policy.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-control-") as folder:
        return _checked_run(case, Path(folder)).row()


def run_case_in_detail(case: ControlCase) -> dict[str, Any]:
    """Returns the row of a case, and the data of its `ApproachLog`.

    Raises:
        ConfigError: as `run_case`.
    """
    with tempfile.TemporaryDirectory(prefix="cpnet-control-") as folder:
        run = _checked_run(case, Path(folder))
        return {**run.row().as_json(), **run.log.as_json()}


def _checked_run(case: ControlCase, folder: Path) -> ControlRun:
    known = OWN_SETTINGS.get(case.policy, ())
    unknown = sorted(set(case.own) - set(known))
    if unknown:
        allowed = ", ".join(known) or "nothing"
        raise ConfigError(f"policy {case.policy}: {unknown[0]} is no setting, allowed: {allowed}")
    return ControlRun(case, folder)


def print_control(rows: list[ControlRow], console: Console) -> None:
    """Prints a table of runs."""
    heads = ("net", "policy", "demand", "seed", "vehicles", "arrived", "delay s", "p95", "wait s")
    estimated = any(row.queue_error is not None for row in rows)
    after = ("queue error", "in interval") if estimated else ()
    table = empty_table((*heads, "stops", "CO2 g", "ms p50", "p99", *after), left=2)
    for row in rows:
        times = row.delay_s, row.delay_p95_s, row.waited_s
        decided = row.decide_p50_ms, row.decide_p99_ms
        table.add_row(
            row.net,
            row.policy,
            f"{row.demand:g}",
            f"{row.seed}",
            f"{row.vehicles}",
            f"{row.arrived}",
            *(f"{value:.1f}" for value in times),
            f"{row.stops:.2f}",
            f"{row.co2_g:.0f}",
            *(f"{value:.1f}" for value in decided),
            *(_estimates(row) if estimated else ()),
        )
    print_whole(table, console)


def _estimates(row: ControlRow) -> tuple[str, str]:
    """Returns the error of the queues that a policy estimated."""
    if row.queue_error is None or row.queue_inside is None:
        return DASH, DASH
    return f"{row.queue_error:.2f}", f"{100 * row.queue_inside:.0f} %"
