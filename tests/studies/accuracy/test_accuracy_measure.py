"""AP40 at a scenario's junction."""

from dataclasses import replace
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from sim_host.junctions import write_net
from studies.accuracy import junction_of, measure_accuracy
from studies.evaluate import EvalRow
from tests.studies.accuracy.small import small


def timeless(rows: list[EvalRow]) -> list[EvalRow]:
    return [replace(row, detect_ms=0.0) for row in rows]


def test_the_seed_decides_the_rows() -> None:
    first, again = (timeless(measure_accuracy(small(), ["fast"], 2)) for _ in range(2))
    assert first == again
    assert {row.scenes for row in first if row.cloud == "merged"} == {2}
    other = timeless(measure_accuracy(small() | {"seed": 2}, ["fast"], 2))
    assert first != other


def test_more_scans_together_find_no_less() -> None:
    rows = measure_accuracy(small(), ["fast"], 2)
    of = {
        row.fusion: row.recall or 0.0
        for row in rows
        if (row.view, row.iou, row.part, row.truth) == ("bev", 0.1, "all", "all")
        and (row.geofence, row.objects) == (True, "vehicle")
    }
    assert of["early"] >= of["none"] > 0.3


def test_a_net_of_the_users_is_measured(tmp_path: Path) -> None:
    net = {"traffic.net": str(write_net(tmp_path)), "junctions": ["J"]}
    rows = measure_accuracy(small(**net), ["fast"], 1)
    assert max(row.ap40 or 0.0 for row in rows) > 0.3


def test_fewer_samples_are_the_first_of_more() -> None:
    (one,), (first, _) = (list(junction_of(small(), count)[1]) for count in (1, 2))
    assert one.boxes.tolist() == first.boxes.tolist()
    assert [scan.agent for scan in one.scans] == [scan.agent for scan in first.scans]


@pytest.mark.parametrize("samples", [0, 501])
def test_a_number_of_samples_out_of_bounds_is_named(samples: int) -> None:
    with pytest.raises(ConfigError, match=f"samples {samples}: must be 1 to 500"):
        measure_accuracy(small(), ["fast"], samples)
