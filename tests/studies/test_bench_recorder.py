"""`cpnet bench recorder`: a small city is recorded completely, with the size of each table."""

import json

import pytest

from protocol.errors import ConfigError
from studies.bench_recorder import VEHICLES, RecorderBench, measure_recorder


def test_a_city_is_recorded_without_a_drop() -> None:
    row = measure_recorder(RecorderBench(junctions=6, regions=3, agents=2, frames=20))
    assert (row.agents, row.vehicles, row.drops) == (6, 6 * VEHICLES, 0)
    assert row.gb_per_hour == pytest.approx(sum(row.gb_by_table.values()))
    least = 50 * row.vehicles * 3600 / 1e9  # six numbers of eight bytes for each vehicle
    assert row.gb_by_table["truth"] > least
    assert row.gb_by_table["detections"] > least
    assert json.dumps(row.as_json())


def test_every_frame_has_the_latency_of_every_agent() -> None:
    few = measure_recorder(RecorderBench(junctions=2, regions=1, agents=1, frames=200))
    many = measure_recorder(RecorderBench(junctions=2, regions=1, agents=8, frames=200))
    assert many.gb_by_table["latency"] > 4 * few.gb_by_table["latency"]


def test_more_regions_than_junctions_are_refused() -> None:
    with pytest.raises(ConfigError, match="--regions 3: allowed are 1 to 2"):
        measure_recorder(RecorderBench(junctions=2, regions=3))
