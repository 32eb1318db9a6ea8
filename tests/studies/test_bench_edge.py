"""`cpnet bench edge` on a little traffic."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from protocol.errors import ConfigError
from studies.bench_edge import STAGES, EdgeBench, measure_edge, numbers_of, print_edge

pytestmark = pytest.mark.slow


def test_each_detector_and_number_of_agents_has_a_row_for_each_stage() -> None:
    bench = EdgeBench(("fast",), (1, 2), frames=2)
    rows = list(measure_edge(bench))
    assert len(rows) == bench.rows
    assert [(row.agents, row.stage) for row in rows] == [(n, s) for n in (1, 2) for s in STAGES]
    for agents in (1, 2):
        ms = {row.stage: row.ms_p50 for row in rows if row.agents == agents}
        assert all(ms[stage] > 0 for stage in ("decode", "place", "ground", "detect"))
        # two frames: a median is their mean, so that what follows one another adds up
        assert sum(ms[s] for s in ("merge", "ground", "detect", "fuse", "count")) < ms["total"]
    assert rows[-1].points > 1.5 * rows[0].points
    assert rows[-1].detections > rows[0].detections > 10
    printed = io.StringIO()
    print_edge(rows, Console(file=printed, width=60))
    assert str(rows[-1].points) in printed.getvalue()
    assert set(rows[0].as_json()) == {
        "detector", "agents", "points", "detections", "stage", "ms_p50", "ms_p95", "peak_mb",
    }  # fmt: skip


@pytest.mark.parametrize("text", ["", "0", "17", "1,x", "2,2", "-1"])
def test_numbers_of_agents_that_cannot_be_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--agents"):
        numbers_of(text)
