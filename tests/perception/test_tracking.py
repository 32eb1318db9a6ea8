"""Tracks: persistent ids, speeds, and coasting of vehicles that no sensor sees."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import linear_sum_assignment

from perception.detector import LIDAR, Vehicles
from perception.tracking import motion
from perception.tracking.association import assign, associate
from perception.tracking.config import TrackingConfig
from perception.tracking.lane_graph import GO, STOP, UNKNOWN, LaneGraph
from perception.tracking.sightlines import RINGS, SECTORS, SightLines
from perception.tracking.tracker import Tracker
from perception.tracking.tracks import Tracks
from protocol.roadmap import Intersection, Lane, Link, RoadMap, Signal

S = 1_000_000_000
DT = S // 10
NOBODY = SightLines.of(np.zeros((0, 3)), [])
CONFIG = TrackingConfig()


def cars(*places: tuple[float, ...], source: str = LIDAR, score: float = 0.9) -> Vehicles:
    """Returns cars at x, y and, if given, yaw."""
    rows = [(*p[:2], 0.75, 4.5, 1.8, 1.5, p[2] if len(p) > 2 else 0.0) for p in places]
    boxes = np.array(rows, np.float64).reshape(-1, 7)
    found = Vehicles.from_lidar(boxes, np.full(len(boxes), score))
    return Vehicles(
        found.boxes,
        found.scores,
        [source] * len(boxes),
        found.position_std_m,
        found.classes,
        found.ends_m,
    )


def road(*lanes: Lane) -> LaneGraph:
    signal = Signal(tls="J", links=[], conflicts=[], plan=[])
    junction = Intersection(signal=signal, centre=(0, 0, 0), outline=[(0, 0), (1, 0), (1, 1)])
    return LaneGraph.of(RoadMap(name="road", lanes=list(lanes), intersections=[junction]))


def lane(name: str, *points: tuple[float, float], after: tuple[str, ...] = ()) -> Lane:
    line = [(x, y, 0.0) for x, y in points]
    length_m = float(np.linalg.norm(np.diff(np.array(points), axis=0), axis=1).sum())
    return Lane(
        id=name, edge=name, width_m=3.5, speed_mps=13.9, length_m=length_m, centreline=line,
        successors=list(after),
    )  # fmt: skip


STRAIGHT = road(lane("a", (0, 0), (400, 0)))


def follow(tracker: Tracker, speed_mps: float, steps: int, start_m: float = 0.0) -> Tracks:
    tracks = Tracks.none()
    for k in range(steps):
        tracks = tracker.step(k * DT, cars((start_m + speed_mps * k / 10, 0)), NOBODY)
    return tracks


def plain_view(*sensors: tuple[float, float]) -> SightLines:
    """Returns sensors 2.5 m high that see the ground everywhere."""
    places = np.array([(x, y, 2.5) for x, y in sensors])
    ground = np.ones((len(sensors), SECTORS, RINGS), np.bool_)
    return SightLines(places, ground)


@pytest.mark.parametrize("lanes", [None, STRAIGHT], ids=["open", "lane"])
@pytest.mark.parametrize("period_ns", [S // 20, S // 10, S])
def test_a_vehicle_keeps_its_id_and_its_speed_is_found(lanes, period_ns) -> None:
    tracker, ids = Tracker(CONFIG, lanes), set()
    for k in range(3 * S // period_ns + 5):
        place_m = 10.0 * k * period_ns / S
        tracks = tracker.step(k * period_ns, cars((place_m, 0)), NOBODY)
        ids.update(tracks.track_ids.tolist())
    assert ids == {1}
    assert tracks.speeds_mps[0] == pytest.approx(10.0, abs=0.5)
    assert tracks.boxes[0, 0] == pytest.approx(place_m, abs=0.3)
    assert tracks.coasted_s[0] == 0


@st.composite
def histories(draw: st.DrawFn) -> list[Vehicles]:
    """Frames of a few cars that move, are missed now and then, and of false boxes."""
    count = draw(st.integers(1, 6))
    frames = []
    for k in range(draw(st.integers(2, 6))):
        seen = draw(st.lists(st.booleans(), min_size=count, max_size=count))
        places = [(20.0 * n + n * k, 3.5 * n) for n in range(count) if seen[n]]
        frames.append(cars(*places, *draw(st.lists(st.tuples(*[st.floats(-50, 150)] * 2)))))
    return frames


@settings(max_examples=40, deadline=None)
@given(histories(), st.randoms(use_true_random=False))
def test_the_order_of_detections_does_not_matter(frames, random) -> None:
    one, other = Tracker(CONFIG, STRAIGHT), Tracker(CONFIG, STRAIGHT)
    for k, frame in enumerate(frames):
        order = list(range(len(frame)))
        random.shuffle(order)
        a = one.step(k * DT, frame, NOBODY)
        b = other.step(k * DT, frame.take(np.array(order, np.int64)), NOBODY)
        assert a.track_ids.tolist() == b.track_ids.tolist()
        np.testing.assert_array_equal(a.boxes, b.boxes)


@settings(max_examples=40, deadline=None)
@given(histories())
def test_a_frame_again_changes_nothing_and_time_that_runs_backwards_is_refused(frames) -> None:
    one, other = Tracker(CONFIG, STRAIGHT), Tracker(CONFIG, STRAIGHT)
    for k, frame in enumerate(frames):
        a = one.step(S + k * DT, frame, NOBODY)
        b = other.step(S + k * DT, frame, NOBODY)
        again = other.step(S + k * DT, cars((1, 1), (60, 1)), NOBODY)
        with pytest.raises(ValueError, match="follows one at"):
            other.step(S + k * DT - 1, cars((2, 2)), NOBODY)
        for tracks in (b, again):
            assert a.track_ids.tolist() == tracks.track_ids.tolist()
            np.testing.assert_array_equal(a.boxes, tracks.boxes)


@given(st.floats(4.0, 15.0), st.floats(0.5, 2.6))
@settings(max_examples=25, deadline=None)
def test_two_vehicles_that_cross_do_not_swap(speed_mps, angle_rad) -> None:
    tracker, ways = Tracker(CONFIG), [(1.0, 0.0), (np.cos(angle_rad), np.sin(angle_rad))]
    held: list[int] = []
    for k in range(41):
        along_m = speed_mps * (k - 20) / 10
        late_m = along_m - 6.0  # the second one passes behind the first
        places = [
            (along_m * ways[0][0], along_m * ways[0][1], 0.0),
            (late_m * ways[1][0], late_m * ways[1][1], angle_rad),
        ]
        tracks = tracker.step(k * DT, cars(*places), NOBODY)
        near = [
            int(tracks.track_ids[np.linalg.norm(tracks.boxes[:, :2] - p[:2], axis=1).argmin()])
            for p in np.array(places)
        ]
        held = held or near
        assert near == held
    assert len(set(held)) == 2


def test_a_second_box_of_a_vehicle_makes_no_second_track() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(10):
        tracks = tracker.step(k * DT, cars((k, 0), (k + 1.2, 0.3)), NOBODY)
        assert len(tracks) <= 2
    assert tracks.track_ids.tolist() == [1]


def test_a_change_of_lane_in_one_frame_is_no_new_vehicle() -> None:
    two = road(lane("a", (0, 0), (400, 0)), lane("b", (0, 3.5), (400, 3.5)))
    tracker = Tracker(CONFIG, two)
    for k in range(30):
        tracks = tracker.step(k * DT, cars((k, 0.0 if k < 20 else 3.5)), NOBODY)
    assert tracks.track_ids.tolist() == [1]


def test_a_change_of_lane_is_not_given_to_a_track_that_may_be_anywhere() -> None:
    tracker = Tracker(CONFIG, road(lane("a", (0, 0), (400, 0)), lane("b", (0, 3.5), (400, 3.5))))
    for k in range(2):
        tracks = tracker.step(k * DT, cars((10.0 * k / 10, 0), (60.0 + k, 7.5)), NOBODY)
    mine = tracks.track_ids[tracks.boxes[:, 0] < 20]
    for k in range(2, 50):  # the other one is lost, and with time it may be anywhere
        tracker.step(k * DT, cars((10.0 * k / 10, 0)), NOBODY)
    tracks = tracker.step(50 * DT, cars((50.0, 3.5)), NOBODY)
    assert tracks.track_ids[tracks.coasted_s == 0].tolist() == mine.tolist()


def test_however_dear_all_pairs_are_none_outside_the_gates_is_chosen() -> None:
    mean, covariance = np.zeros((2, 6)), np.tile(60.0**2 * np.eye(6), (2, 1, 1))
    mean[1, 0] = 300.0
    boxes = np.column_stack([cars((-100, 0), (150, 0)).boxes, np.zeros((2, 2))])
    traits = np.tile([4.5, 0.0, 0.9, 1.0, 1.0], (2, 1))
    std = np.full((2, 3), 0.3)
    found, _ = associate(mean, covariance, traits, boxes, std, np.array([(1.5, 1.3)]), 9.0)
    assert found[0] != 1  # 400 m away, where the gate is 180 m


@given(hnp.arrays(np.float64, (6, 6), elements=st.floats(-9, 9)), st.integers(0, 6))
def test_an_assignment_costs_as_little_as_that_of_scipy(costs, rows) -> None:
    columns = assign(np.ascontiguousarray(costs[:rows]))
    assert len(set(columns.tolist())) == rows
    best = costs[linear_sum_assignment(costs[:rows])].sum()
    assert costs[np.arange(rows), columns].sum() == pytest.approx(best)


@pytest.mark.parametrize("costs", [np.ones((3, 2)), np.full((2, 2), np.nan), np.zeros((1, 0))])
def test_no_assignment_is_made_where_there_is_none(costs) -> None:
    with pytest.raises(ValueError, match="no column is left"):
        assign(costs)


def test_two_vehicles_abreast_that_are_seen_as_one_across_the_road_drive_on() -> None:
    tracker = Tracker(CONFIG, road(lane("a", (0, 0), (400, 0)), lane("b", (0, 3.0), (400, 3.0))))
    for k in range(20):
        tracks = tracker.step(k * DT, cars((1.0 * k, 0), (1.0 * k, 3.0)), NOBODY)
    ids = tracks.track_ids.tolist()
    tracks = tracker.step(20 * DT, cars((19.5, 1.0, np.pi / 2)), NOBODY)
    assert set(tracks.track_ids.tolist()) <= set(ids)
    assert tracks.speeds_mps == pytest.approx(10.0, abs=0.7)
    tracks = tracker.step(21 * DT, cars((21.0, 0), (21.0, 3.0)), NOBODY)
    assert tracks.track_ids.tolist() == ids


def test_the_box_of_two_vehicles_abreast_says_nothing_of_their_lengths() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        tracker.step(k * DT, cars((1.0 * k, 0)), NOBODY)
    both = cars((19.5, 0.5, np.pi / 2))
    both.boxes[0, 3], both.ends_m[0] = 5.3, (-2.65, 2.65)
    tracks = tracker.step(20 * DT, both, NOBODY)
    assert tracks.boxes[:, 3] == pytest.approx([4.5])


def test_a_vehicle_whose_place_another_track_seems_to_take_for_a_frame_keeps_its_id() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        stands = [(20.0, 2.0, np.pi / 2)] if k >= 10 else []
        tracks = tracker.step(k * DT, cars((1.0 * k, 0), *stands), NOBODY)
    passing, standing = tracks.track_ids.tolist()
    tracks = tracker.step(20 * DT, cars((20.0, 1.4, np.pi / 2)), NOBODY)
    assert tracks.track_ids[tracks.coasted_s == 0].tolist() == [standing]
    tracks = tracker.step(21 * DT, cars((21.0, 0)), NOBODY)
    assert passing in tracks.track_ids[tracks.coasted_s == 0]


def test_an_agent_keeps_its_track_however_far_it_is_off() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(10):
        seen = cars((20 + k, 0)) + cars((100 + (12 if k == 7 else 0) + k, 0), source="cav")
        tracks = tracker.step(k * DT, seen, NOBODY)
    assert sorted(tracks.sources) == ["cav", LIDAR]
    assert tracks.track_ids.tolist() == [1, 2]


def test_a_vehicle_that_begins_to_report_itself_keeps_the_id_that_the_lidar_gave() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 8.0, 10)
    tracks = tracker.step(10 * DT, cars((8.0, 0), source="cv"), NOBODY)
    assert (tracks.track_ids.tolist(), tracks.sources) == ([1], ["cv"])


@pytest.mark.parametrize("speed_mps", [0.0, 9.0])
def test_a_vehicle_hidden_for_5_s_comes_back_under_its_id(speed_mps) -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, speed_mps, 30, start_m=5.0)
    for k in range(30, 80):
        tracks = tracker.step(k * DT, cars(), NOBODY)
        if len(tracks):
            assert tracks.coasted_s[0] == pytest.approx((k - 29) / 10)
    place_m = tracker._states.mean[0, 0]
    tracks = tracker.step(80 * DT, cars((place_m + 3.0 * (speed_mps > 0), 0)), NOBODY)
    assert (tracks.track_ids.tolist(), tracks.coasted_s.tolist()) == ([1], [0.0])


@pytest.mark.parametrize("speed_mps", [8.0, 11.0, 15.0])
def test_who_drives_more_slowly_or_faster_than_is_allowed_keeps_its_speed_unseen(speed_mps) -> None:
    """Drivers differ: here 13.9 m/s are allowed."""
    tracker = Tracker(TrackingConfig(publish_probability=0.05), STRAIGHT)
    follow(tracker, speed_mps, 60)
    for k in range(60, 90):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.coasted_s[0] == pytest.approx(3.0)
    assert tracks.boxes[0, 0] == pytest.approx(speed_mps * 8.9, abs=2.0)


def test_a_speed_that_was_guessed_at_birth_is_none_that_a_driver_keeps() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 9.0, 12)
    for k in range(12, 32):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.speeds_mps[0] < 11.0  # 13.9 m/s are allowed, and were guessed


def test_who_leaves_a_slow_lane_drives_on_as_its_driver_likes() -> None:
    slow = lane("slow", (0, 0), (60, 0), after=("fast",)).model_copy(update={"speed_mps": 7.0})
    tracker = Tracker(
        TrackingConfig(publish_probability=0.05), road(slow, lane("fast", (60, 0), (500, 0)))
    )
    follow(tracker, 6.3, 80)
    for k in range(80, 140):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.speeds_mps[0] == pytest.approx(0.9 * 13.9, abs=0.7)


def test_who_still_accelerates_goes_on_to_do_so_unseen() -> None:
    tracker = Tracker(TrackingConfig(publish_probability=0.05), STRAIGHT)
    for k in range(50):
        place_m = 0.5 * 1.5 * (k / 10) ** 2
        tracker.step(k * DT, cars((place_m, 0)), NOBODY)
    for k in range(50, 80):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.speeds_mps[0] > 10.5


@pytest.mark.parametrize(("gap_m", "stands"), [(8.0, True), (60.0, False)])
def test_in_the_first_frame_who_is_close_behind_another_stands(gap_m, stands) -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    tracks = tracker.step(0, cars((100, 0), (100 - gap_m, 0)), NOBODY)
    behind = tracks.boxes[:, 0].argmin()
    assert (tracks.speeds_mps[behind] < 1.0) == stands


def test_a_new_vehicle_does_not_stand_because_one_stands_behind_it() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(5):
        tracker.step(k * DT, cars((50.0, 0)), NOBODY)
    tracks = tracker.step(5 * DT, cars((50.0, 0), (70.0, 0)), NOBODY)
    assert tracks.speeds_mps[tracks.boxes[:, 0] > 60] == pytest.approx(13.9)


def test_a_new_vehicle_is_no_slower_than_the_one_ahead() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        tracker.step(k * DT, cars((50.0 + k, 0)), NOBODY)
    tracks = tracker.step(20 * DT, cars((62.0, 0), (70.0, 0)), NOBODY)
    assert tracks.speeds_mps[tracks.boxes[:, 0] < 65] == pytest.approx(10.0, abs=0.5)


def test_who_stands_unseen_stays_where_it_is() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 0.0, 30, start_m=50.0)
    for k in range(30, 330):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.boxes[0, 0] == pytest.approx(50.0, abs=0.3)
    assert tracks.scores[0] < 0.9


def test_two_detections_in_one_place_are_not_of_a_vehicle_that_stands_there_for_long() -> None:
    # They may be of two vehicles that followed each other, where nobody saw them but there.
    tracker, at_once = Tracker(CONFIG, STRAIGHT), []
    for second in range(15):
        there = cars((50.0, 0)) if second < 2 else cars()
        at_once.append(len(tracker.step(second * 10 * DT, there, NOBODY)))
    assert at_once[2] == 1
    assert at_once[-1] == 0


def test_an_empty_place_in_plain_view_ends_a_track_at_once_and_a_shadow_does_not() -> None:
    seen, hidden = Tracker(CONFIG, STRAIGHT), Tracker(CONFIG, STRAIGHT)
    for tracker in (seen, hidden):
        follow(tracker, 0.0, 30, start_m=50.0)
    assert len(seen.step(30 * DT, cars(), plain_view((30, 3)))) == 0
    assert len(hidden.step(30 * DT, cars(), NOBODY)) == 1


def test_where_nobody_knows_what_sensors_saw_a_track_ends_within_seconds() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 0.0, 30, start_m=50.0)
    alive = [len(tracker.step((30 + k) * DT, cars(), None)) for k in range(50)]
    assert (alive[0], alive[-1]) == (1, 0)


def test_a_hidden_vehicle_follows_its_lane_round_a_bend() -> None:
    arc = [(100 + 30 * np.sin(a), 30 - 30 * np.cos(a)) for a in np.linspace(0, np.pi / 2, 20)]
    bend = road(
        lane("in", (0, 0), (100, 0), after=("turn",)),
        lane("turn", *arc, after=("out",)),
        lane("out", (130, 30), (130, 300)),
    )
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), bend)
    follow(tracker, 13.0, 70)
    for k in range(70, 125):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.boxes[0, 0] == pytest.approx(130, abs=0.5)
    assert tracks.boxes[0, 1] > 35
    assert tracks.boxes[0, 6] == pytest.approx(np.pi / 2, abs=0.05)


def test_a_hidden_vehicle_stops_behind_a_queue() -> None:
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), STRAIGHT)
    for k in range(40):
        tracker.step(k * DT, cars((k * 1.2, 0), (150, 0), (157, 0)), NOBODY)
    for k in range(40, 240):
        tracks = tracker.step(k * DT, cars((150, 0), (157, 0)), NOBODY)
        (mine,) = np.flatnonzero(tracks.coasted_s > 0)
        assert tracks.boxes[mine, 0] < 150 - 4.5
    assert tracks.boxes[mine, 0] == pytest.approx(143, abs=1.5)
    assert tracks.speeds_mps[mine] < 0.2


def test_who_is_hidden_between_two_that_stand_stays_known() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(10):
        tracker.step(k * DT, cars((100, 0), (107, 0), (114, 0)), NOBODY)
    for k in range(10, 600):
        tracks = tracker.step(k * DT, cars((100, 0), (114, 0)), NOBODY)
        assert tracks.boxes[tracks.coasted_s > 0, 0] == pytest.approx([107], abs=0.5)
    assert tracks.position_std_m[tracks.coasted_s > 0] < 1.5


def test_who_is_hidden_where_there_is_no_room_for_it_does_not_become_certain() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(10):
        tracker.step(k * DT, cars((100, 0), (107, 0), (114, 0)), NOBODY)
    for k in range(10, 400):
        tracks = tracker.step(k * DT, cars((103, 0), (111, 0)), NOBODY)
    assert (tracks.position_std_m[tracks.coasted_s > 0] > 0.7).all()


def test_who_was_born_first_does_not_matter_to_those_that_follow_each_other_unseen() -> None:
    ends_m = []
    for born_first in (0, 1):
        tracker = Tracker(CONFIG, STRAIGHT)
        for k in range(30):
            # one begins a frame before the other
            places = [(60.0 + 0.8 * k, 0.0), (80.0 + 0.8 * k, 0.0)]
            seen = cars(*places) if k else cars(places[born_first])
            tracker.step(k * DT, seen + cars((150, 0)), NOBODY)
        for k in range(30, 60):
            tracks = tracker.step(k * DT, cars((150, 0)), NOBODY)
        ends_m.append(np.sort(tracks.boxes[:, 0]))
    np.testing.assert_allclose(*ends_m, atol=0.3)


@pytest.mark.parametrize(("gap_m", "is_known"), [(12.0, True), (60.0, False)])
def test_who_is_hidden_behind_a_vehicle_that_is_seen_keeps_the_gap_to_it(gap_m, is_known) -> None:
    """Where there is much room ahead, nobody knows how fast it drives."""
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(130):
        x_m = 75 + 8.0 * k / 10
        seen = cars((x_m, 0), (x_m - gap_m, 0)) if k < 30 else cars((x_m, 0))
        tracks = tracker.step(k * DT, seen, NOBODY)
    hidden_m = x_m - tracks.boxes[tracks.coasted_s > 0, 0]
    assert hidden_m == pytest.approx([gap_m] if is_known else [], abs=3.5)


@pytest.mark.parametrize("lanes", [None, STRAIGHT], ids=["open", "lane"])
def test_on_a_lane_a_box_that_falls_back_turns_nobody_round(lanes) -> None:
    """Its first box was too long. In the open nobody knows but that it drives the other way."""
    tracker = Tracker(CONFIG, lanes)
    for k, x_m in enumerate((50.0, 49.2, 48.2)):
        tracks = tracker.step(k * DT, cars((x_m, 0)), NOBODY)
    assert np.cos(tracks.boxes[0, 6]) == pytest.approx(1 if lanes else -1, abs=0.01)
    assert tracks.speeds_mps[0] >= -motion.BACKWARDS_MPS


def test_a_first_box_that_looked_the_other_way_puts_nobody_on_the_oncoming_lane() -> None:
    there, back = lane("a", (0, 0), (400, 0)), lane("b", (400, 3.5), (0, 3.5))
    tracker = Tracker(CONFIG, road(there, back))
    for k in range(20):
        tracks = tracker.step(k * DT, cars((50 + 0.5 * k, 0, 0.0 if k else np.pi)), NOBODY)
    assert np.cos(tracks.boxes[0, 6]) == pytest.approx(1, abs=0.01)
    assert tracks.speeds_mps == pytest.approx([5.0], abs=0.5)


def test_a_hidden_vehicle_leaves_the_map_where_its_lane_ends() -> None:
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), STRAIGHT)
    follow(tracker, 13.0, 30, start_m=340.0)
    counts = [len(tracker.step(k * DT, cars(), NOBODY)) for k in range(30, 60)]
    assert (counts[0], counts[-1]) == (1, 0)


def test_most_vehicles_show_the_way_at_a_fork() -> None:
    fork = road(
        lane("in", (0, 0), (100, 0), after=("ahead", "left")),
        lane("ahead", (100, 0), (300, 0)),
        lane("left", (100, 0), (110, 5), (115, 15), (115, 200)),
    )
    tracker, k = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), fork), 0
    turn = [(100 + t, t / 2, 0.46) for t in range(10)] + [
        (110 + t, 5 + 2 * t, 1.1) for t in range(5)
    ]
    for _ in range(8):  # vehicles that all turn left
        for place in [(x, 0.0, 0.0) for x in range(60, 100)] + turn:
            tracker.step(k * DT, cars(place), NOBODY)
            k += 1
    for x in np.arange(60, 95):
        tracker.step(k * DT, cars((x, 0)), NOBODY)
        k += 1
    for _ in range(30):
        tracks = tracker.step(k * DT, cars(), NOBODY)
        k += 1
    newest = tracks.track_ids.argmax()
    assert tracks.boxes[newest, 1] > 5
    assert tracks.existence[newest] < 0.95  # it may have gone straight on


def test_a_gap_in_the_frames_is_no_end_of_tracks() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 10.0, 20)
    tracks = tracker.step(19 * DT + 2 * S, cars((39, 0)), NOBODY)
    assert tracks.track_ids.tolist() == [1]


def test_who_forgets_begins_anew_and_gives_no_id_twice() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 10.0, 5)
    tracker.forget()
    assert tracker.step(0, cars((0, 0)), NOBODY).track_ids.tolist() == [2]
    again = Tracker(CONFIG, STRAIGHT, first_id=1 << 20)
    assert again.step(0, cars((0, 0)), NOBODY).track_ids.tolist() == [1 << 20]


def test_a_false_box_of_one_frame_does_not_coast() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    tracker.step(0, cars((50, 0)), NOBODY)
    assert len(tracker.step(DT, cars(), NOBODY)) == 0


def test_a_doubtful_box_is_shown_once_it_is_confirmed() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    shown = [len(tracker.step(k * DT, cars((50, 0), score=0.05), NOBODY)) for k in range(4)]
    assert shown == [0, 1, 1, 1]


def test_people_are_no_cars_and_follow_no_lane() -> None:
    walker = Vehicles.from_lidar(np.array([[50, 0, 0.85, 0.5, 0.6, 1.7, 0.0]]), np.ones(1))
    tracker = Tracker(CONFIG, STRAIGHT)
    tracker.step(0, cars((50, 0)), NOBODY)
    tracks = tracker.step(DT, walker, NOBODY)
    assert tracks.track_ids.tolist() == [2]
    assert tracker._states.lane[tracker._states.ids == 2].tolist() == [-1]


@pytest.mark.parametrize("in_one_place", [True, False])
def test_ten_thousand_boxes_from_a_liar_end_in_bounded_memory_and_time(in_one_place) -> None:
    rng = np.random.default_rng(1)
    tracker = Tracker(CONFIG, STRAIGHT)
    tracker.step(0, cars((0, 0)), NOBODY)
    started_s = time.process_time()
    for k in range(1, 4):
        spread_m = 5.0 if in_one_place else 5000.0
        lies = cars(*rng.uniform(-spread_m, spread_m, (10_000, 2)), score=0.5)
        tracks = tracker.step(k * DT, cars((k, 0)) + lies, NOBODY)
        assert len(tracker._states) <= CONFIG.max_tracks
        assert 1 in tracks.track_ids
    assert tracker.refused >= 3 * (10_000 - CONFIG.max_tracks)
    assert time.process_time() - started_s < 20


def known(ids: list[int], *places: tuple[float, float], coasted_s: float = 0.0) -> Tracks:
    tracker = Tracker(CONFIG)
    tracks = tracker.step(0, cars(*places), NOBODY)
    order = np.argsort([places.index(tuple(b)) for b in tracks.boxes[:, :2].tolist()])
    taken = tracks.take(order)
    taken.track_ids[:] = ids
    taken.coasted_s[:] = coasted_s
    taken.speeds_mps[:] = 5.0
    return taken


def test_a_neighbours_ids_are_taken_over_and_what_it_knows_is_known() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    tracks = follow(tracker, 10.0, 10)
    tracker.adopt(9 * DT, known([77, 78], (9.4, 0.1), (200.0, 0.0), coasted_s=1.0))
    tracks = tracker.step(10 * DT, cars((10, 0)), NOBODY)
    assert tracks.track_ids.tolist() == [77, 78]
    assert tracks.boxes[1, 0] == pytest.approx(200.5, abs=0.3)
    assert tracks.coasted_s[1] == pytest.approx(1.1)


def test_who_is_taken_over_unseen_keeps_the_speed_that_it_had() -> None:
    tracker = Tracker(TrackingConfig(publish_probability=0.05), STRAIGHT)
    tracker.step(0, cars(), NOBODY)
    theirs = replace(known([7], (20.0, 0.0)), speeds_mps=np.array([9.0]))
    tracker.adopt(0, theirs)
    for k in range(1, 31):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.speeds_mps[0] == pytest.approx(9.0, abs=0.2)


def test_what_a_neighbour_knew_at_another_time_is_not_taken_over() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 10.0, 10)
    tracker.adopt(8 * DT, known([77], (9.4, 0.1)))
    assert tracker.step(10 * DT, cars((10, 0)), NOBODY).track_ids.tolist() == [1]


def test_an_id_that_is_known_is_not_given_to_a_second_track() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(10):
        tracker.step(k * DT, cars((k, 0), (100, 0)), NOBODY)
    first = tracker._states.ids[tracker._states.mean[:, 0] < 50][0]
    tracker.adopt(9 * DT, known([int(first)], (100.0, 0.0)))
    assert sorted(tracker.step(10 * DT, cars((10, 0), (100, 0)), NOBODY).track_ids) == [1, 2]


def test_a_lane_without_length_is_passed() -> None:
    broken = road(
        lane("a", (0, 0), (50, 0), after=("b",)),
        lane("b", (50, 0), (50, 0), after=("c",)),
        lane("c", (50, 0), (300, 0)),
    )
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), broken)
    follow(tracker, 10.0, 40)
    for k in range(40, 60):
        tracks = tracker.step(k * DT, cars(), NOBODY)
    assert tracks.boxes[0, 0] > 55


def seen_from(x_m: float) -> SightLines:
    """Returns a sensor beside the lane that sees no ground."""
    return SightLines.of(np.array([(x_m, 3.0, 2.5)]), [np.zeros((0, 3), np.float32)])


def test_a_bonnet_between_two_beams_neither_stops_nor_turns_a_vehicle() -> None:
    tracker, worst_mps, worst_m = Tracker(CONFIG, STRAIGHT), 0.0, 0.0
    for k in range(60):
        hidden_m = 1.5 if 40 <= k < 43 or k == 50 else 0.0  # the box begins at the windscreen
        tracks = tracker.step(k * DT, cars((k - hidden_m, 0)), seen_from(90))
        if k >= 40:
            worst_mps = max(worst_mps, abs(tracks.speeds_mps[0] - 10.0))
            worst_m = max(worst_m, abs(tracks.boxes[0, 0] - k))
    assert tracks.track_ids.tolist() == [1]
    assert worst_mps < 2.0
    assert worst_m < 1.0


def test_the_end_that_a_sensor_sees_tells_where_a_vehicle_is_whatever_length_is_seen() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(40):
        whole = np.array([[k, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0]])
        if k % 2 and k > 20:
            whole[0, [0, 3]] = k + 0.75, 3.0  # only the front part of it
        tracks = tracker.step(k * DT, Vehicles.from_lidar(whole, np.ones(1)), seen_from(200))
    assert tracks.boxes[0, 0] == pytest.approx(39, abs=0.4)
    assert tracks.speeds_mps[0] == pytest.approx(10, abs=0.4)


def test_an_end_that_was_seen_tells_where_a_vehicle_is_on_whichever_side_the_sensors_are() -> None:
    tracker, sensor = Tracker(CONFIG, STRAIGHT), plain_view((0.0, 0.0))
    for k in range(30):
        whole, place_m = k < 15, 40.0 + k
        seen = cars((place_m if whole else place_m + 0.75, 0))
        seen.boxes[0, 3] = 4.5 if whole else 3.0
        seen.ends_m[0] = (-2.25, 2.25) if whole else (np.nan, 1.5)
        tracks = tracker.step(k * DT, seen, sensor)
    assert tracks.boxes[0, 0] == pytest.approx(place_m, abs=0.1)
    assert tracks.speeds_mps[0] == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize("sensors", [NOBODY, None, plain_view((0.0, 0.0))])
def test_a_vehicle_is_as_long_as_it_was_where_both_ends_were_seen(sensors) -> None:
    """Its boxes, of a usual car's length, begin at its rear."""
    tracker, lengths_m = Tracker(CONFIG, STRAIGHT), []
    for k in range(30):
        seen = cars((40.3 + k, 0))
        seen.ends_m[0] = (-2.25, 1.65) if 10 <= k < 20 else (-2.25, np.nan)
        tracks = tracker.step(k * DT, seen, sensors)
        lengths_m.append(tracks.boxes[0, 3])
    np.testing.assert_allclose(lengths_m, [4.5] * 10 + [3.9] * 20)
    assert tracks.boxes[0, 0] == pytest.approx(69, abs=0.1)


def test_a_vehicle_that_is_seen_whole_at_first_is_as_long_and_where_its_ends_are() -> None:
    seen = cars((10, 20, np.pi / 2))
    seen.ends_m[0] = (-2.25, 1.5)
    (box,) = Tracker(CONFIG).step(0, seen, NOBODY).boxes
    np.testing.assert_allclose(box[[0, 1, 3]], [10, 19.625, 3.75])


def test_whoever_reports_its_length_is_so_long_until_it_is_distrusted() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        seen = cars((50, 0), source="liar")
        seen.boxes[0, 3] = 18.0
        tracks = tracker.step(k * DT, seen, NOBODY)
    assert tracks.boxes[0, 3] == 18.0
    tracker.distrust({"liar"}, np.zeros((0, 2)), 100.0)
    tracks = tracker.step(20 * DT, cars((50, 0)), NOBODY)
    assert tracks.boxes[0, 3] == 4.5


def test_a_lorry_seen_in_parts_keeps_its_id() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(60):
        box = [100.0, 0, 1.7, 8.5, 2.5, 3.4, 0.0]
        if k > 30 and k % 3 == 0:
            box[0], box[3] = 102.0, 4.5
        elif k > 30 and k % 3 == 1:
            box[0], box[3] = 97.9, 4.5
        found = Vehicles.from_lidar(np.array([box]), np.ones(1))
        tracks = tracker.step(k * DT, found, NOBODY)
        assert 1 in tracks.track_ids
    assert tracks.track_ids.tolist() == [1]


def test_a_bicycle_that_is_taken_for_a_person_keeps_its_id() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        size = (0.6, 0.5, 1.7) if k % 4 == 3 else (1.8, 0.65, 1.75)
        box = np.array([[50 + k * 0.4, 0, 0.9, *size, 0.0]])
        tracks = tracker.step(k * DT, Vehicles.from_lidar(box, np.ones(1)), NOBODY)
    assert tracks.track_ids.tolist() == [1]


def crossing() -> LaneGraph:
    """Returns a lane that ends at x = 100 at the only light of the signal J, and goes on."""
    lanes = [
        lane("in", (0, 0), (100, 0), after=("over",)),
        lane("over", (100, 0), (120, 0), after=("out",)).model_copy(update={"internal": True}),
        lane("out", (120, 0), (400, 0)),
    ]
    links = [Link(index=0, from_lane="in", to_lane="out")]
    signal = Signal(tls="J", links=links, conflicts=[], plan=[])
    junction = Intersection(signal=signal, centre=(110, 0, 0), outline=[(100, 0), (120, 0), (9, 9)])
    return LaneGraph.of(RoadMap(name="road", lanes=lanes, intersections=[junction]))


@pytest.mark.parametrize(
    ("state", "light"), [("r", STOP), ("y", STOP), ("G", GO), ("g", UNKNOWN), ("", UNKNOWN)]
)
def test_a_light_says_stop_or_go_to_the_way_that_it_is_for(state, light) -> None:
    assert crossing().lights({"J": state, "another": "r"}).tolist() == [light, UNKNOWN]


def test_a_hidden_vehicle_waits_at_a_red_light_and_goes_at_green() -> None:
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), crossing())
    follow(tracker, 12.0, 40)
    for k in range(40, 180):
        tracks = tracker.step(k * DT, cars(), NOBODY, {"J": "r"})
    assert tracks.boxes[0, 0] == pytest.approx(97, abs=1.0)
    assert tracks.speeds_mps[0] < 0.2
    for k in range(180, 220):
        tracks = tracker.step(k * DT, cars(), NOBODY, {"J": "G"})
    assert tracks.boxes[0, 0] > 103


def test_who_is_seen_to_go_from_a_red_light_between_two_frames_does_not_stand() -> None:
    tracker = Tracker(CONFIG, crossing())
    for k in range(10):
        tracks = tracker.step(k * S, cars((97.0, 0)), NOBODY, {"J": "r"})
    assert tracks.speeds_mps[0] < 0.3
    tracks = tracker.step(10 * S, cars((98.2, 0)), NOBODY, {"J": "r"})
    assert tracks.speeds_mps[0] > 0.8
    assert tracks.boxes[0, 0] == pytest.approx(98.2, abs=0.3)


def test_who_cannot_stop_before_a_light_any_more_goes_on() -> None:
    tracker = Tracker(CONFIG.model_copy(update={"publish_probability": 0.01}), crossing())
    follow(tracker, 12.0, 80)  # 5 m before the bar
    for k in range(80, 110):
        tracks = tracker.step(k * DT, cars(), NOBODY, {"J": "y"})
    assert tracks.boxes[0, 0] > 120


def test_what_a_distrusted_agent_may_have_shown_does_not_coast_and_keeps_its_id_if_seen() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        tracker.step(k * DT, cars((50, 0), (70, 0), (300, 0)), NOBODY)
    far = tracker._states.ids[tracker._states.mean[:, 0] > 200].tolist()
    near = tracker._states.ids[np.abs(tracker._states.mean[:, 0] - 70) < 5].tolist()
    tracker.distrust({"liar"}, np.array([[60.0, 0.0]]), 100.0)
    tracks = tracker.step(20 * DT, cars((70, 0)), NOBODY)
    assert sorted(tracks.track_ids.tolist()) == sorted(far + near)


def test_an_agent_that_is_distrusted_is_not_there_any_more() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(20):
        tracker.step(k * DT, cars((50, 0), source="liar"), NOBODY)
    tracker.distrust({"liar"}, np.zeros((0, 2)), 100.0)
    assert len(tracker.step(20 * DT, cars(), NOBODY)) == 0


def errors_mps(tracks: list[Tracks], truth_mps: list[float]) -> np.ndarray:
    """Returns by how much the only track of each frame is too fast."""
    return np.array([one.speeds_mps[0] - v for one, v in zip(tracks, truth_mps, strict=True)])


def test_the_first_frame_in_which_a_vehicle_is_hidden_is_not_lost() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 13.9, 30)
    for k in range(30, 40):
        (box,) = tracker.step(k * DT, cars(), NOBODY).boxes
        assert box[0] == pytest.approx(1.39 * k, abs=0.3)


def test_who_stops_does_not_drive_backwards() -> None:
    errors = []
    for seed in range(10):
        rng, tracker = np.random.default_rng(seed), Tracker(CONFIG, STRAIGHT)
        at_m, v, tracks, truth_mps = 0.0, 13.9, [], []
        for k in range(110):
            after = max(v - 0.4, 0.0) if k > 50 else v
            at_m, v = at_m + (v + after) / 20, after
            truth_mps.append(v)
            tracks.append(tracker.step(k * DT, cars((at_m + rng.normal(0, 0.05), 0)), NOBODY))
        errors.append(errors_mps(tracks[85:95], truth_mps[85:95]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.2
    assert np.mean(errors) > -0.1


@pytest.mark.parametrize("length_m", [3.9, 4.5, 4.9])
def test_a_length_that_turns_out_to_be_another_moves_no_end_that_was_seen(length_m: float) -> None:
    """A car is completed to 4.5 m from the end that is seen, then seen whole, then from behind."""
    tracker, errors = Tracker(CONFIG, STRAIGHT), []
    for k in range(140):
        at_m, half_m = 50.0 + k, length_m / 2
        front_m, rear_m = at_m + half_m, at_m - half_m
        ends_m = (-half_m, half_m)
        if k < 50:
            rear_m, ends_m = front_m - 4.5, (np.nan, 2.25)
        elif k > 90:
            front_m, ends_m = rear_m + 4.5, (-2.25, np.nan)
        box = np.array([((front_m + rear_m) / 2, 0, 0.75, front_m - rear_m, 1.8, 1.5, 0)])
        found = replace(Vehicles.from_lidar(box, np.ones(1)), ends_m=np.array([ends_m]))
        tracks = tracker.step(k * DT, found, seen_from(120.0))
        errors.append(tracks.speeds_mps[0] - 10.0)
    assert np.abs(errors[30:]).max() < 0.15
    assert tracks.boxes[0, 3] == pytest.approx(length_m, abs=0.05)


def test_nobody_changes_to_an_oncoming_lane() -> None:
    """A vehicle is hidden as another one comes into view beside it, on the oncoming lane."""
    lanes = road(lane("a", (0, 0), (400, 0)), lane("b", (400, 3.5), (0, 3.5)))
    tracker = Tracker(CONFIG, lanes)
    follow(tracker, 10.0, 30)
    for k in range(30, 50):
        here = cars((81 - k, 3.5, np.pi)) if k >= 40 else cars()
        tracks = tracker.step(k * DT, here, seen_from(40.0))
    places = dict(zip(tracks.track_ids.tolist(), tracks.boxes[:, :2].tolist(), strict=True))
    assert places == {
        1: pytest.approx([49, 0], abs=1.0),
        2: pytest.approx([32, 3.5], abs=0.3),
    }


@pytest.mark.parametrize("aside_m", [0.0, 3.0])
def test_a_false_box_that_was_turned_otherwise_is_not_the_next_vehicle(aside_m: float) -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    tracker.step(0, cars((50, aside_m, 1.5)), NOBODY)
    for k in range(5, 15):
        tracks = tracker.step(k * DT, cars((50 + 1.5 * (k - 5), 0)), NOBODY)
        vehicle = tracks.take(tracks.coasted_s == 0)
        assert vehicle.track_ids.tolist() == [2]
        assert vehicle.speeds_mps[0] == pytest.approx(15, abs=3)


def test_a_part_of_a_vehicle_is_not_a_new_one_and_says_little_of_where_that_is() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(40):
        tracker.step(k * DT, cars((10 + k, 0), (15 + k, 0)), NOBODY)
    ahead, part = (55, 0, 0.75, 4.5, 1.8, 1.5, 0), (51.6, 0.9, 0.75, 1.0, 1.0, 1.5, 0)
    found = Vehicles.from_lidar(np.array([ahead, part]), np.full(2, 0.9))
    tracks = tracker.step(40 * DT, found, NOBODY)
    assert tracks.track_ids.tolist() == [1, 2]
    assert tracks.coasted_s.tolist() == [0, 0]
    assert tracks.boxes[0, :2] == pytest.approx([50, 0], abs=0.3)
    assert tracks.speeds_mps[0] == pytest.approx(10, abs=0.5)


def test_a_new_vehicle_stands_behind_one_that_stands_on_the_next_lane() -> None:
    lanes = road(lane("a", (0, 0), (100, 0), after=("b",)), lane("b", (100, 0), (200, 0)))
    tracker = Tracker(CONFIG, lanes)
    for k in range(10):
        tracker.step(k * DT, cars((103, 0)), NOBODY)
    tracks = tracker.step(10 * DT, cars((103, 0), (95.5, 0)), NOBODY)
    assert np.abs(tracks.speeds_mps).max() < 0.3


def test_a_hidden_queue_starts_as_drivers_do() -> None:
    """Two metres a second faster each second: SUMO's drivers, and what most do."""
    tracker = Tracker(CONFIG, crossing())
    for k in range(20):
        tracker.step(k * DT, cars((96, 0)), NOBODY, {"J": "r"})
    for k in range(20, 50):
        tracks = tracker.step(k * DT, cars(), seen_from(60.0), {"J": "G"})
    assert tracks.speeds_mps[0] == pytest.approx(6.0, abs=1.0)


def test_who_changes_lane_is_not_moved_along_too() -> None:
    """A vehicle is hidden as another one comes into view beside and behind it, in the next lane."""
    lanes = road(lane("a", (0, 0), (400, 0)), lane("b", (0, 3.5), (400, 3.5)))
    tracker = Tracker(CONFIG, lanes)
    follow(tracker, 10.0, 40)
    for k in range(40, 50):
        tracks = tracker.step(k * DT, cars((k - 2.5, 3.5)), seen_from(40.0))
    assert sorted(tracks.track_ids.tolist()) == [1, 2]
    aside = tracker.step(50 * DT, cars((47.5, 3.5), (50, -3.5)), seen_from(40.0))
    assert sorted(aside.track_ids.tolist()) == [1, 2]  # it comes back a lane farther to the right


def test_a_vehicle_whose_first_box_lay_across_the_road_begins_again_under_its_id() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    first = tracker.step(0, cars((51, 0.5, 1.57)), NOBODY)
    for k in range(1, 10):
        tracks = tracker.step(k * DT, cars((50 + 1.4 * k, 0)), NOBODY)
        assert tracks.track_ids.tolist() == first.track_ids.tolist()
    assert tracks.boxes[0, 6] == pytest.approx(0, abs=0.1)
    assert tracks.first_seen_ns.tolist() == [0]


def test_a_vehicle_whose_boxes_are_turned_in_turn_is_confirmed() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    for k in range(12):
        tracker.step(k * DT, cars((50 + 1.4 * k, 0, 1.57 * (k % 2))), NOBODY)
    hidden = tracker.step(12 * DT, cars(), NOBODY)
    assert hidden.coasted_s.tolist() == [pytest.approx(0.1)]
    assert hidden.boxes[0, 6] == pytest.approx(0, abs=0.2)


def test_a_bicycle_keeps_its_heading_however_its_boxes_are_turned() -> None:
    rng = np.random.default_rng(1)
    tracker = Tracker(CONFIG)
    for k in range(40):
        turned = 0.0 if k < 20 else rng.uniform(-0.6, 0.6)
        box = np.array([[50 + 0.5 * k, 0, 0.9, 1.8, 0.65, 1.75, turned]])
        tracks = tracker.step(k * DT, Vehicles.from_lidar(box, np.ones(1)), NOBODY)
        assert abs(tracks.boxes[0, 6]) < 0.2
    assert tracks.speeds_mps[0] == pytest.approx(5.0, abs=0.5)


def test_what_is_as_small_as_a_person_where_a_vehicle_was_is_a_part_of_it() -> None:
    tracker = Tracker(CONFIG, STRAIGHT)
    follow(tracker, 5.0, 20)  # 10 m on
    part = np.array([[11.2, 0.3, 0.85, 0.5, 0.6, 1.7, 0.0]])
    tracks = tracker.step(20 * DT, Vehicles.from_lidar(part, np.ones(1)), NOBODY)
    assert tracks.track_ids.tolist() == [1]
    assert tracks.classes.tolist() == [0]
    assert tracks.boxes[0, 0] == pytest.approx(10, abs=0.5)
    part[0, 1] = 1.1
    aside = tracker.step(21 * DT, Vehicles.from_lidar(part, np.ones(1)), NOBODY)
    assert aside.track_ids[aside.coasted_s == 0].tolist() == [2]
