"""What looking on costs a real run."""

import pytest

from cpnet.bench_looking import LookingBench, measure_looking
from protocol.errors import ConfigError

FEW_RAYS = {
    f"lidar.{kind}.{key}": value
    for kind in ("vehicle", "roadside")
    for key, value in (("channels", 16), ("points_per_second", 96_000))
}


def test_a_run_goes_on_while_it_is_taped() -> None:
    (row,) = measure_looking(LookingBench(ways=("record",), looks=1, span_s=3, keys=FEW_RAYS))
    assert (row.way, row.spans) == ("record", 1)
    assert row.alone_hz > 0
    assert 0 < row.low <= row.share <= row.high


def test_unknown_ways_are_named_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="--ways .telepathy.: must be of record, save, web"):
        measure_looking(LookingBench(ways=("record", "telepathy")))


def test_scenario_keys_are_checked_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match="duration_s"):
        measure_looking(LookingBench(keys={"duration_s": -1}))
