"""What looking on costs a real run."""

import pytest

from cpnet.bench_looking import LookingBench, measure_looking
from protocol.errors import ConfigError

FEW_RAYS = {
    f"lidar.{kind}.{key}": value
    for kind in ("vehicle", "roadside")
    for key, value in (("channels", 16), ("points_per_second", 96_000))
}


def test_runs_go_on_while_they_are_taped() -> None:
    bench = LookingBench(ways=("record",), pairs=3, frames=60, keys=FEW_RAYS)
    (row,) = measure_looking(bench)
    assert row.way == "record"
    assert row.pairs >= 1
    assert row.alone_hz > 0
    assert 0 < row.low <= row.share <= row.high


@pytest.mark.parametrize("way", ["telepathy", "record+telepathy", ""])
def test_unknown_ways_are_named_with_what_there_is(way: str) -> None:
    with pytest.raises(ConfigError, match=rf"--ways '{way.replace('+', '.')}': must be of record,"):
        [*measure_looking(LookingBench(ways=("record", way)))]


def test_scenario_keys_are_checked_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match="duration_s"):
        [*measure_looking(LookingBench(keys={"duration_s": -1}))]
