"""`cpnet bench scale`: what it takes, what it prints."""

from __future__ import annotations

import json
import time
from pathlib import Path

import psutil
import pytest

from cpnet.bench_scale import ProcessMeter, ScaleBench
from protocol.errors import ConfigError
from tests.cpnet.commands import Shell
from tests.waiting import wait_until


@pytest.mark.parametrize(
    ("junctions", "duration_s", "text"),
    [
        ("two", 60, "--junctions two: must be numbers with commas"),
        ("1,2", 60, "--junctions 2: must be a square, 1 to 676"),
        ("0", 60, "--junctions 0: must be a square"),
        ("729", 60, "--junctions 729: must be a square"),
        ("4", 5, "--duration 5: must be 20 or more"),
    ],
)
def test_what_cannot_be_measured_is_said(junctions: str, duration_s: float, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ScaleBench.of(junctions, duration_s, 0.05).check()


def test_a_city_has_a_region_for_25_junctions() -> None:
    bench = ScaleBench((1, 16, 100), 60, 0.05)
    assert [bench.overrides(n)["regions"] for n in bench.junctions] == [1, 1, 4]


def test_cpu_time_is_that_between_two_moments(tmp_path: Path) -> None:
    listing = tmp_path / "processes.json"
    listing.write_text(json.dumps({"vehicle-0": psutil.Process().pid}))
    with ProcessMeter(listing) as meter:
        wait_until(lambda: len(meter._cpu.get("vehicle-0", [])) >= 2)
        begin_ns, begin_s = time.monotonic_ns(), time.process_time()
        while time.process_time() < begin_s + 1.0:
            sum(range(1000))
        end_ns, spent_s = time.monotonic_ns(), time.process_time() - begin_s
        seen = len(meter._cpu["vehicle-0"])
        wait_until(lambda: len(meter._cpu["vehicle-0"]) >= seen + 2)
    assert meter.cpu_s(begin_ns, end_ns)["vehicle-0"] == pytest.approx(spent_s, abs=0.4)
    assert meter.growth_mb(begin_ns) >= 0


def test_the_bench_prints_a_row_for_each_size(shell: Shell) -> None:
    status, text = shell.start(
        "bench", "scale", "--junctions=1", "--duration=20", "--json"
    ).finish()
    assert status == 0, text
    [row] = json.loads(text[text.index("[\n") :])
    roles = {"supervisor", "router", "sim", "record", "edge", "signal", "infra", "vehicle"}
    assert row["core_ms_by_role"].keys() == roles
    assert sum(row["core_ms_by_role"].values()) == pytest.approx(row["core_ms"])
    assert row["parts_ms"].keys() == {"cast", "encode", "edge"}
    assert (row["junctions"], row["regions"], row["frames"]) == (1, 1, 9)
    assert row["agents"] >= 1
