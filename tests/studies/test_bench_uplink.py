"""`cpnet bench uplink` on a little traffic: what policies send and what is still detected."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpnet.bench import UplinkBench, overrides, read_cell
from cpnet.scenario import load
from studies.bench import WARM_UP_FRAMES
from studies.bench_traffic import record_traffic
from studies.bench_uplink import UplinkRow
from studies.in_process import run_in_process

BENCH = UplinkBench(agents=4, frames=WARM_UP_FRAMES + 4)
BYTES = {"full": (28e3, 38e3), "reap+foreground": (4e3, 9e3), "objects": (100, 1500)}


@pytest.fixture(scope="module")
def rows(tmp_path_factory) -> dict[str, UplinkRow]:
    folder: Path = tmp_path_factory.mktemp("bench")
    record_traffic(folder, BENCH.agents, BENCH.frames)
    found = {}
    for number, policy in enumerate(BYTES):
        run_dir = folder / f"{number}"
        run_dir.mkdir()
        scenario = load("t_junction", overrides(BENCH, folder, policy, "5mbit"))
        run_in_process(scenario.model_dump(mode="json"), run_dir)
        found[policy] = read_cell(BENCH, folder, policy, "5mbit", run_dir)
    return found


@pytest.mark.parametrize("policy", BYTES)
def test_a_policy_sends_bytes_of_its_order_of_magnitude(rows, policy) -> None:
    low, high = BYTES[policy]
    assert low < rows[policy].bytes_per_frame < high
    assert rows[policy].fps == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize(
    ("policy", "recall"), [("full", 0.95), ("reap+foreground", 0.95), ("objects", 0.8)]
)
def test_visible_vehicles_are_detected_and_counted(rows, policy, recall) -> None:
    row = rows[policy]
    assert row.recall_visible > recall
    assert row.count_error < 0.6
    assert row.false_per_frame < 2
