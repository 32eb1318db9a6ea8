"""Traffic measures from trajectories: on a made-up road, with countable answers."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from protocol.errors import ConfigError
from studies.trajectories import (
    GREENS,
    SCHEMA,
    Layout,
    arrivals,
    crossings,
    greens,
    headways,
    movements,
    queues_at_green,
    saturation_flows,
    speeds_by_lane,
    write_trajectories,
)
from tests.roads import junction_road
from tests.studies.tracked_runs import make_run

LAYOUT = Layout.of(junction_road())
"""From the west `far_0`, `in_0` (stop bar at x = -10), `:j_0`, `out_0`; 13.9 m/s."""


def table(rows: Iterable[tuple[int, float, float, float, str, float]]) -> pl.DataFrame:
    """Rows of (track, time, distance to the bar, speed, lane, heading)."""
    full = [
        (t, s, -10 - d, 0.0, 0.0, yaw, v, 4.0, 1.8, "car", lane, d, 0.0, "r0")
        for t, s, d, v, lane, yaw in sorted(rows)
    ]
    return pl.DataFrame(full, SCHEMA, orient="row")


def queue_that_starts(count: int, headway_s: float, *, lane: str = "in_0") -> pl.DataFrame:
    """Vehicles stand 7 m apart until 10 s, then cross at 12 s and so many seconds after each."""
    rows = []
    for n in range(count):
        cross_s = 12 + n * headway_s
        for half in range(2 * math.ceil(cross_s + 3)):
            at_s = half / 2
            moves = at_s > 10
            left_m = 2 + 7 * n
            distance_m = left_m * (cross_s - at_s) / (cross_s - 10) if moves else left_m
            place = lane if distance_m >= 0 else "out_0"
            rows.append((n + 1, at_s, distance_m, 5.0 if moves else 0.0, place, 0.0))
    return table(rows)


ONE_GREEN = pl.DataFrame([("j", "in_0", 10.0, 40.0)], GREENS, orient="row")


def test_greens_are_those_of_a_lanes_links() -> None:
    states = pl.DataFrame(
        [
            ("j", float(t), state)
            for t, state in enumerate(["GGr", "yyr", "rrG", "rrG", "gGr", "Grr"])
        ],
        {"tls": pl.String, "time_s": pl.Float64, "state": pl.String},
        orient="row",
    )
    found = greens(states, LAYOUT.links)
    # the start of the first green is unknown
    assert found.rows() == [
        ("j", "in_0", 4.0, 5.0),
        ("j", "in_1", 4.0, 5.0),
        ("j", "side_0", 2.0, 4.0),
    ]


def test_the_mean_speed_is_that_in_space_and_percentiles_are_of_tracks() -> None:
    fast = [(1, n / 10, 100.0 - n, 10.0, "in_0", 0.0) for n in range(10)]
    slow = [(2, n / 10, 100.0 - n, 2.0, "in_0", 0.0) for n in range(30)]
    (row,) = speeds_by_lane(table(fast + slow)).rows(named=True)
    assert (row["lane"], row["tracks"]) == ("in_0", 2)
    assert row["mean_mps"] == pytest.approx(4.0)
    assert row["p50_mps"] == pytest.approx(6.0)
    assert row["p85_mps"] == pytest.approx(2 + 0.85 * 8)


def test_people_and_places_off_the_road_have_no_part_in_it() -> None:
    person = table([(1, 0.0, 5.0, 1.0, "in_0", 0.0)]).with_columns(
        pl.lit("pedestrian").alias("class")
    )
    off = table([(2, 0.0, 0.0, 1.0, "", 0.0)])
    assert speeds_by_lane(pl.concat([person, off])).is_empty()


def test_a_queue_reaches_to_the_end_of_the_last_that_stands() -> None:
    standing = queue_that_starts(4, 2.0)
    (row,) = queues_at_green(standing, ONE_GREEN, LAYOUT.approach).rows()
    assert row == ("in_0", 10.0, 4, 2 + 7 * 3 + 2)
    moving = [(9, 10.0, 30.0, 8.0, "in_0", 0.0), (10, 10.0, 60.0, 0.0, "in_0", 0.0)]
    both = pl.concat([standing, table(moving)])  # one that drives, one too far behind the others
    assert queues_at_green(both, ONE_GREEN, LAYOUT.approach).rows() == [row]


def test_a_queue_goes_on_over_lanes_that_lead_to_this_one() -> None:
    places = [10.0 + 20 * n for n in range(9)]
    rows = [
        (n, 10.0, at_m, 0.0, "in_0" if at_m < 150 else "far_0", 0.0)
        for n, at_m in enumerate(places, 1)
    ]
    found = queues_at_green(table(rows), ONE_GREEN, LAYOUT.approach).rows()
    assert found == [("in_0", 10.0, 9, 172.0)]


def test_a_green_without_a_queue_has_none() -> None:
    none = table([(1, 10.0, 50.0, 9.0, "in_0", 0.0)])
    assert queues_at_green(none, ONE_GREEN, LAYOUT.approach).rows() == [("in_0", 10.0, 0, 0.0)]
    assert queues_at_green(none.clear(), ONE_GREEN, LAYOUT.approach).rows() == [
        ("in_0", 10.0, 0, 0.0)
    ]


def test_crossings_lie_between_frames() -> None:
    rows = [
        (1, 0.0, 3.0, 9.0, "in_0", 0.0),
        (1, 1.0, -6.0, 9.0, ":j_0", 0.0),
        (1, 2.0, -30.0, 9.0, "out_0", 0.1),
    ]
    (row,) = crossings(table(rows), LAYOUT).rows(named=True)
    assert (row["track"], row["lane"], row["to"]) == (1, "in_0", "out_0")
    assert row["time_s"] == pytest.approx(1 / 3)


def test_movements_are_named_by_the_roads_that_they_join_whatever_the_boxes_say() -> None:
    def trip(
        track: int, lane: str, yaw: float, to: str, out: float
    ) -> list[tuple[int, float, float, float, str, float]]:
        return [(track, 0.0, 4.0, 9.0, lane, yaw), (track, 1.0, -4.0, 9.0, to, out)]

    rows = trip(1, "in_0", 0, "out_0", 0) + trip(2, "in_1", 3.1, "out_1", -1.6)
    rows += trip(3, "side_0", math.pi / 2, "out_0", 0)
    found = movements(crossings(table(rows), LAYOUT), LAYOUT)
    assert sorted(found.rows()) == [("in", "out", "through", 2), ("side", "out", "right", 1)]


@pytest.mark.parametrize(
    ("out_deg", "turn"),
    [(0, "through"), (90, "left"), (-90, "right"), (180, "U-turn"), (-175, "U-turn")],
)
def test_a_turn_is_told_by_how_far_the_heading_changes(out_deg: float, turn: str) -> None:
    headings_deg = {"in_0": (0.0, 350.0), "out_0": (out_deg - 10, 0.0)}
    assert replace(LAYOUT, headings_deg=headings_deg).turn("in_0", "out_0") == turn


def test_saturation_flow_leaves_the_first_four_aside() -> None:
    queue = queue_that_starts(8, 2.0)
    crossed = crossings(queue, LAYOUT)
    found = headways(queue, ONE_GREEN, crossed, LAYOUT.approach)
    assert found["position"].to_list() == list(range(1, 9))
    assert found["headway_s"].to_list() == pytest.approx([2.0] * 8)  # the first: 2 s after green
    assert saturation_flows(found).rows() == [("in_0", 4, pytest.approx(1800.0))]


def test_who_did_not_stand_or_comes_after_the_green_is_no_headway() -> None:
    queue = queue_that_starts(3, 2.0)
    passing = [
        (9, n / 2, 100 - 5.0 * n, 10.0, "in_0" if n <= 20 else "out_0", 0.0) for n in range(40)
    ]
    both = pl.concat([queue, table(passing)])
    short = ONE_GREEN.with_columns(pl.lit(15.0).alias("end_s"))
    found = headways(both, short, crossings(both, LAYOUT), LAYOUT.approach)
    assert found["position"].to_list() == [1, 2]
    assert saturation_flows(found).is_empty()


def test_arrivals_are_placed_in_the_cycle_of_their_lane() -> None:
    cycles = [("j", "in_0", 10.0, 30.0), ("j", "in_0", 70.0, 90.0), ("j", "in_0", 130.0, 150.0)]
    shown = pl.DataFrame(cycles, GREENS, orient="row")

    def drive(track: int, start_s: float) -> list[tuple[int, float, float, float, str, float]]:
        """Passes 100 m before the bar 1 s after its start."""
        return [(track, start_s + n, 110 - 10.0 * n, 10.0, "in_0", 0.0) for n in range(10)]

    late_s = 100 / 13.9
    found = arrivals(
        table(drive(1, 19) + drive(2, 49) + drive(3, 79) + drive(4, 0) + drive(5, 140)),
        shown,
        LAYOUT,
    )
    assert found["track"].to_list() == [1, 2, 3]  # not before the first green, nor in the last
    assert found["since_green_s"].to_list() == pytest.approx(
        [10 + late_s, 40 + late_s, 10 + late_s]
    )
    assert found["on_green"].to_list() == [True, False, True]
    assert set(found["cycle_s"].to_list()) == {60.0}


def test_trajectories_are_written_with_their_columns(tmp_path: Path) -> None:
    make_run(tmp_path)
    file = tmp_path / "tracks.parquet"
    assert write_trajectories(tmp_path, file) == 1
    found = pl.read_parquet(file)
    assert dict(found.schema) == {name: kind() for name, kind in SCHEMA.items()}
    assert len(found) == 40
    assert found["sim_time_s"].to_list()[:3] == pytest.approx([0, 0.1, 0.2])
    assert found.row(12, named=True)["coasted_s"] == pytest.approx(0.3)
    assert set(found["class"]) == {"car"}


def test_trajectories_need_tracks_and_a_name_that_tells_what_they_are(tmp_path: Path) -> None:
    make_run(tmp_path, track=0)
    with pytest.raises(ConfigError, match="has no tracks"):
        write_trajectories(tmp_path, tmp_path / "a.parquet")
    with pytest.raises(ConfigError, match="must be the name of a .parquet file"):
        write_trajectories(tmp_path, tmp_path / "a.csv")
    tracked = tmp_path / "tracked"
    tracked.mkdir()
    make_run(tracked)
    with pytest.raises(ConfigError, match="cannot be written"):
        write_trajectories(tracked, tmp_path / "none" / "a.parquet")
