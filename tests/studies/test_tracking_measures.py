"""The measures of tracks: HOTA and its like, speeds, coasting, on made-up frames and runs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from studies.run_tracks import evaluate_run
from studies.tracking import (
    Sequences,
    TrackedFrame,
    TrackScore,
    bev_iou,
    centre_similarity,
    memory_score,
)
from tests.studies.tracked_runs import SIZE, make_run


def boxes_at(x_m: Sequence[float]) -> np.ndarray:
    return np.array([(x, 0.0, 0.75, *SIZE, 0.0) for x in x_m]).reshape(-1, 7)


def frame(
    number: int,
    vehicles: dict[str, float],
    tracks: dict[int, float],
    *,
    coasted_s: float = 0.0,
    speed_mps: float = 10.0,
    score: float = 0.9,
    due: bool = True,
) -> TrackedFrame:
    """Vehicles and tracks at places along a road, at 10 Hz."""
    return TrackedFrame(
        time_s=number / 10,
        vehicles=list(vehicles),
        vehicle_boxes=boxes_at(list(vehicles.values())),
        vehicle_speeds_mps=np.full(len(vehicles), 10.0),
        due=np.full(len(vehicles), due),
        tracks=list(tracks),
        boxes=boxes_at(list(tracks.values())),
        speeds_mps=np.full(len(tracks), speed_mps),
        scores=np.full(len(tracks), score),
        coasted_s=np.full(len(tracks), coasted_s),
        inside=np.ones(len(tracks), np.bool_),
    )


def score_of(frames: list[TrackedFrame]) -> TrackScore:
    return TrackScore.of(Sequences.of(frames, centre_similarity))


def test_tracks_that_follow_every_vehicle_have_full_marks() -> None:
    frames = [frame(n, {"a": n, "b": 50 - n}, {7: n, 8: 50 - n}) for n in range(20)]
    found = score_of(frames)
    shares = (found.hota, found.assa, found.deta, found.idf1, found.mota, found.amota, found.samota)
    assert shares == pytest.approx((1, 1, 1, 1, 1, 1, 1))
    assert (found.id_switches, found.fragmentations, found.passages) == (0, 0, 2)
    assert TrackScore.hota_of(Sequences.of(frames, bev_iou)) == pytest.approx(1)


def test_a_change_of_id_half_way_is_a_switch_and_halves_the_association() -> None:
    found = score_of([frame(n, {"a": n}, {7 if n < 10 else 8: n}) for n in range(20)])
    assert (found.id_switches, found.fragmentations) == (1, 0)
    assert found.deta == pytest.approx(1)
    assert found.assa == pytest.approx(0.5)
    assert found.idf1 == pytest.approx(0.5)
    assert found.mota == pytest.approx(0.95)


def test_a_missing_middle_is_a_fragmentation_and_a_ghost_is_false() -> None:
    frames = [frame(n, {"a": n}, {9: n + 30.0} | ({} if n == 5 else {7: n})) for n in range(10)]
    found = score_of(frames)
    assert (found.id_switches, found.fragmentations) == (0, 1)
    assert found.mota == pytest.approx(1 - (1 + 10) / 10)


def test_boxes_that_are_off_by_less_than_two_metres_match_and_lower_hota() -> None:
    near, far = ([frame(n, {"a": n}, {7: n + off}) for n in range(9)] for off in (1.5, 2.1))
    assert score_of(near).mota == pytest.approx(1)
    assert score_of(near).hota == pytest.approx(5 / 19, abs=0.01)  # at similarity 0.25
    assert score_of(far).mota == pytest.approx(-1)


def test_what_follows_a_vehicle_that_is_not_due_is_neither_true_nor_false() -> None:
    assert score_of([frame(0, {"a": 0}, {7: 0}, due=False)]).passages == 0
    mixed = [replace(frame(0, {"a": 0, "b": 20}, {7: 0, 8: 20}), due=np.array([True, False]))]
    assert score_of(mixed).mota == pytest.approx(1)


def test_a_box_of_nothing_is_false_only_inside() -> None:
    ghost = frame(0, {"a": 0}, {7: 0, 8: 30})
    assert score_of([ghost]).mota == pytest.approx(0)
    assert score_of([replace(ghost, inside=np.array([True, False]))]).mota == pytest.approx(1)
    assert score_of([replace(ghost, inside=np.array([False, True]))]).mota == pytest.approx(0)


def test_without_vehicles_nothing_is_measured() -> None:
    assert score_of([frame(0, {}, {7: 0})]).hota is None
    assert TrackScore.hota_of(Sequences.of([], bev_iou)) is None


def test_amota_is_the_mean_over_recalls_that_leave_out_the_unsure() -> None:
    frames = [
        replace(
            frame(n, {"a": n, "b": 50 - n}, {7: n, 8: 50 - n}), scores=np.array([0.9, 0.4])
        ) for n in range(20)
    ]  # fmt: skip
    found = score_of(frames)
    assert found.amota == pytest.approx((0.5 + 1) / 2)
    # at recalls below one half, half of the vehicles are found: more than asked for counts 1
    assert found.samota == pytest.approx(1)


def test_leaving_out_unsure_tracks_raises_amota() -> None:
    sure = [frame(n, {"a": n}, {7: n}) for n in range(10)]
    ghosts = [replace(
        frame(n, {"a": n}, {7: n, 8: n + 40}), scores=np.array([0.9, 0.1])
    ) for n in range(10)]  # fmt: skip
    assert score_of(ghosts).amota == pytest.approx(score_of(sure).amota)
    assert score_of(ghosts).mota == pytest.approx(0)


def test_speed_errors_are_told_apart_by_sight() -> None:
    frames = [
        frame(0, {"a": 0}, {7: 0}, speed_mps=10.3),
        frame(1, {"a": 1}, {7: 1}, speed_mps=-9.7),
    ]
    frames += [frame(2, {"a": 2}, {7: 2}, speed_mps=12, coasted_s=0.1)]
    found = memory_score(frames)
    assert found.observed_rmse_mps == pytest.approx(0.3)
    assert found.coasted_rmse_mps == pytest.approx(2)


def hidden_for(frames: int, back_as: int) -> list[TrackedFrame]:
    shown = [frame(n, {"a": n / 10}, {7: n / 10}) for n in range(3)]
    shown += [frame(n, {"a": n / 10}, {}) for n in range(3, 3 + frames)]
    return [*shown, frame(3 + frames, {"a": 0.0}, {back_as: 0.0})]


def test_hidden_vehicles_that_come_back_under_their_id_are_recovered() -> None:
    for frames, back_as, hidden, recovered in (
        (20, 7, 1, 1), (20, 8, 1, 0), (60, 7, 0, 0), (0, 7, 0, 0),
    ):  # fmt: skip
        found = memory_score(hidden_for(frames, back_as))
        assert (found.hidden, found.recovered) == (hidden, recovered)


def test_a_coasting_box_is_near_only_while_its_own_vehicle_is() -> None:
    def coasting(at_m: float) -> list[TrackedFrame]:
        seen = frame(0, {"a": 0, "b": 60}, {7: 0})
        return [seen, *(
            frame(n, {"a": 0, "b": 60}, {7: at_m}, coasted_s=n / 10) for n in range(1, 36)
        )]  # fmt: skip

    for at_m, near in ((1.9, 1), (2.1, 0), (60.0, 0)):
        found = memory_score(coasting(at_m))
        assert (found.coasted, found.near) == (1, near)


def test_a_run_is_measured_whole_and_by_sight(tmp_path: Path) -> None:
    make_run(tmp_path)
    found = evaluate_run(tmp_path).as_json()
    assert {key for key, value in found.items() if not isinstance(value, dict)} == {
        "hota", "assa", "deta", "idf1", "mota", "amota", "samota", "id_switches", "fragmentations",
        "passages", "hota_iou",
    }  # fmt: skip
    assert (found["passages"], found["id_switches"], found["fragmentations"]) == (1, 0, 1)
    assert found["mota"] == pytest.approx(1 - 20 / 40)
    assert found["idf1"] == pytest.approx(0.75)
    assert found["speed_rmse_mps"] == {
        "observed": pytest.approx(0.5),
        "coasted": pytest.approx(0.5),
    }
    assert found["precision"] == {"observed": 1.0, "coasted": 0.5, "all": 0.75}
    assert found["ecvpr"] == {
        "observed": 0.5,
        "all": 0.75,
        "visible_so_far": 0.75,  # from the tenth of forty frames on
        "in_range_so_far": 1.0,
    }
    assert found["hidden"] == {"vehicles": 1, "recovered": 1.0}
    assert found["coasted_3s"] == {"boxes": 0, "within_2m": None}


def test_a_run_without_tracks_is_refused(tmp_path: Path) -> None:
    make_run(tmp_path, track=0)
    with pytest.raises(ConfigError, match="has no tracks"):
        evaluate_run(tmp_path)
