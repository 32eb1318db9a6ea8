"""Matching of detections with vehicles, the signal's reach, and E-CVPR."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import VehicleType
from recording.database import Database
from recording.run import Run
from recording.tables import CountRow, DetectionRow, FrameRow, MetaRow, TruthRow
from studies.count_error import count_errors
from studies.ecvpr import (
    EvaluationArea,
    FrameScore,
    match,
    matched_vehicles,
    score,
    score_frame,
)
from studies.summary import traffic_of
from tests.roads import straight_road
from tests.studies.straight_runs import write_setup

COORDINATES = st.floats(-15, 15, allow_nan=False)


@pytest.mark.parametrize(
    ("name", "position_m", "inside"),
    [
        ("in", 0.0, True),
        ("in", 150.0, True),
        ("far", 249.0, False),
        ("far", 250.0, True),
        (":j", 5.0, True),
        ("out", 80.0, True),
        ("beyond", 10.0, True),
        ("beyond", 11.0, False),
        ("elsewhere", 0.0, False),
    ],
)
def test_the_reach_is_measured_along_the_lanes(name: str, position_m: float, inside: bool) -> None:
    assert EvaluationArea(straight_road()).contains(name, position_m) is inside


def test_a_centre_up_to_half_a_metre_beside_the_footprint_matches() -> None:
    vehicles, sizes = np.array([[0.0, 0.0, np.pi / 2]]), np.array([[4.0, 2.0]])
    for centre, expected in {(1.4, 0): 1, (1.6, 0): 0, (0, 2.4): 1, (0, 2.6): 0}.items():
        assert len(match(np.array([centre], float), vehicles, sizes)) == expected


def test_two_detections_of_one_vehicle_count_once_and_the_nearer_is_taken() -> None:
    centres = np.array([[0.5, 0.0], [0.1, 0.0]])
    assert match(centres, np.zeros((1, 3)), np.array([[4.0, 2.0]])) == [(1, 0)]


def test_nothing_matches_nothing() -> None:
    assert match(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 2))) == []
    assert match(np.zeros((3, 2)), np.zeros((0, 3)), np.zeros((0, 2))) == []


@given(
    centres=st.lists(st.tuples(COORDINATES, COORDINATES), max_size=12),
    vehicles=st.lists(st.tuples(COORDINATES, COORDINATES, COORDINATES), max_size=8, unique=True),
    seed=st.integers(0, 1000),
)
def test_a_permutation_gives_the_same_pairs(
    centres: list[tuple[float, float]], vehicles: list[tuple[float, float, float]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    c, v = np.array(centres).reshape(-1, 2), np.array(vehicles).reshape(-1, 3)
    sizes = np.tile([4.0, 2.0], (len(v), 1))
    order_c, order_v = rng.permutation(len(c)), rng.permutation(len(v))
    plain = {(*c[i], *v[j]) for i, j in match(c, v, sizes)}
    mixed = {(*c[order_c][i], *v[order_v][j]) for i, j in match(c[order_c], v[order_v], sizes)}
    assert plain == mixed
    pairs = match(c, v, sizes)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)


def truth(frame: int, vehicle: str, x_m: float, name: str, position_m: float) -> TruthRow:
    return TruthRow(frame, vehicle, "car", 0, x_m, 0, 0, 0, 0, 0, 5.0, name, position_m)


def detection(frame: int, number: int, x_m: float) -> DetectionRow:
    return DetectionRow(frame, "r0", number, x_m, 0, 0.7, 4, 2, 1.5, 0, 1.0, 0, "in", 5.0, "lidar")


def frame_row(frame: int, detections: int | None) -> FrameRow:
    return FrameRow(frame, frame * 10**8, 1, 0, 0, 0, 0, detections, 1, frame, None, None)


def test_a_parked_car_is_neither_true_nor_false_and_a_pedestrian_no_car() -> None:
    vehicles = [
        truth(0, "v", 100.0, "in", 100.0),
        truth(0, "parked~0", 102.0, "", 0.0),
        truth(0, "pedestrian~7", 140.0, "", 0.0),
    ]
    kinds = {
        name: VehicleType(name=name, mesh="car", length_m=4, width_m=2, height_m=1)
        for name in {one.type for one in vehicles}
    }
    found = [detection(0, n, x_m) for n, x_m in enumerate((101.1, 102.0, 140.0, 170.0))]
    one = score_frame(0, found, vehicles, kinds, EvaluationArea(straight_road()))
    # The first lies nearer to the parked car, but vehicles are matched before bystanders are.
    assert (one.present, one.true, one.false) == (1, 1, 2)
    assert matched_vehicles(found, vehicles, kinds) == ({"v"}, 2)


def test_e_cvpr_is_true_detections_over_vehicles_present(tmp_path: Path) -> None:
    write_setup(tmp_path)
    database = Database(tmp_path)
    near, left, far = ("a", -10.0, "in", 145.0), ("b", 20.0, "out", 15.0), ("c", -400, "far", 55.0)
    database.add(TruthRow, [truth(frame, *v) for frame in range(3) for v in (near, left, far)])
    database.add(TruthRow, [truth(3, *far)])
    seen_in_frame_0 = [-9.5, -400.0, 300.0]  # one present, one beyond the reach, one of nothing
    database.add(DetectionRow, [detection(0, i, x) for i, x in enumerate(seen_in_frame_0)])
    database.add(FrameRow, [frame_row(0, 3), frame_row(1, 0), frame_row(2, None), frame_row(3, 0)])
    database.close()
    with Run(tmp_path) as run:
        scores = score(run)
    assert scores == [FrameScore(0, 2, 1, 1), FrameScore(1, 2, 0, 0), FrameScore(3, 0, 0, 0)]
    assert [s.e_cvpr for s in scores] == [0.5, 0.0, None]


def test_a_frame_in_which_nobody_is_there_counts_and_so_do_its_false_detections(
    tmp_path: Path,
) -> None:
    write_setup(tmp_path)
    database = Database(tmp_path)
    database.add(TruthRow, [truth(1, "a", -10.0, "in", 145.0)])
    database.add(DetectionRow, [detection(frame, 0, -60.0) for frame in range(3)])
    database.add(CountRow, [CountRow(frame, "j", "in", "upstream", 1, 0, 0) for frame in range(3)])
    database.add(FrameRow, [frame_row(frame, 1) for frame in range(3)])
    database.add(MetaRow, {"scenario": "{}", "end_reason": "finished"}.items())
    database.close()
    with Run(tmp_path) as run:
        assert [(one.present, one.false) for one in score(run)] == [(0, 1), (1, 1), (0, 1)]
        assert count_errors(run) == {"j": [1, 0, 1]}
        assert traffic_of(run)["vehicles"]["at_start"] == 0


def test_a_run_without_truth_has_no_scores(tmp_path: Path) -> None:
    write_setup(tmp_path)
    database = Database(tmp_path)
    database.add(DetectionRow, [detection(0, 0, -60.0)])
    database.add(FrameRow, [frame_row(0, 1)])
    database.close()
    with Run(tmp_path) as run:
        assert (score(run), count_errors(run)) == ([], {})
