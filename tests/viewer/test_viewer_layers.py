"""Layers drawn of messages: arrays, texts, colours."""

import numpy as np
import pytest

from protocol import messages as m
from protocol.codec import encode_cloud
from protocol.scans import PointCloud
from studies import palette
from tests.messages import SCAN, tracked
from tests.roads import CROSSING
from tests.viewer.shown import CAR, detections, truth
from viewer import layers
from viewer.layers import MAX_REMEMBERED, Colours, rgb
from viewer.road import camera, count_place, count_places, heads, surface
from viewer.scene import Moment, TruthScorer, clouds, phase_names, pressures


def test_boxes_are_labelled_with_who_and_where() -> None:
    boxes = layers.detected(detections(), {"a": (1, 2, 3)})
    assert boxes.labels == ["#1 · south_0 · 2 km/h", "a · off the lanes · 2 km/h"]
    assert boxes.colours == [rgb(palette.BOX), (1, 2, 3)]
    assert boxes.values.shape == (2, 7)


def test_the_first_of_each_lane_bears_its_label() -> None:
    message = detections(
        boxes=np.zeros((5, 7), np.float32), scores=np.ones(5, np.float32),
        classes=np.zeros(5, np.uint8),
        lanes=["a", "a", "b", "c", "d"], sources=["lidar", "lidar", "lidar", "self", "lidar"],
        distances_m=np.array([9, 4, 7, 1, -2], np.float32), **tracked(5),
    )  # fmt: skip
    assert layers.fronts(message).texts == ["#2 · a · 2 km/h", "#3 · b · 2 km/h"]


def test_truth_stands_on_the_ground_and_unknown_types_are_left_out() -> None:
    boxes = layers.true_boxes(truth(), {"car": CAR})
    assert boxes.values.tolist() == [[0, -20.3, 0.75, 4, 2, 1.5, np.pi / 2]]
    assert boxes.labels == ["v · south_0"]


@pytest.mark.parametrize(
    ("shown", "south", "west"), [("Gr", "G", "r"), ("yr", "y", "r"), ("r", "r", ""), ("", "", "")]
)
def test_lamps_show_what_their_lanes_are_shown(shown: str, south: str, west: str) -> None:
    state = m.SignalState(
        frame=1, sim_time_ns=1, tls="J", state=shown, stage="green", green=shown, source="plan",
        earliest_change_ns=0,
    )  # fmt: skip
    found = layers.lamps({"J": state}, CROSSING, heads(CROSSING).lanes)
    assert found == [rgb(palette.SIGNAL.get(c, palette.FAINT)) for c in (south, west)]


def test_counts_stand_at_their_lanes_with_a_mark_where_nobody_sees() -> None:
    counts = m.LaneCounts(
        frame=1, sim_time_ns=1, tls="J", agents=[], complete=True,
        upstream={"south_0": 3, "gone_0": 1}, downstream={"east_0": 0},
        coverage_downstream={"east_0": 0.0},
    )  # fmt: skip
    found = layers.lane_counts([counts], count_places(CROSSING))
    assert found.texts == ["3", "0?"]
    assert found.places[0] == pytest.approx(count_place(CROSSING.by_id["south_0"], "upstream"))
    assert -80 < found.places[0][1] < -5 < 5 < found.places[1][0] < 80


def test_cells_are_clipped_to_a_box_and_have_their_agents_colours() -> None:
    plan = m.Plan(
        frame=1, agent="a", mbps=0, enough=-1, agents=["a", "b"],
        sites=np.array([[-10.0, 0], [10, 0]]), weights_m2=np.zeros((2, 3)),
    )  # fmt: skip
    areas = {"r0": layers.CellArea.around(CROSSING.intersections)}
    found = layers.plan_cells({"r0": plan}, areas, {"a": (1, 1, 1), "b": (2, 2, 2)})
    assert found.names == ["a", "b"]
    left, right = found.lines
    assert left[:, 0].max() == pytest.approx(0)
    assert right[:, 0].min() == pytest.approx(0)
    assert np.abs(left[:, :2]).max() == layers.CELLS_REACH_M
    assert (left[0] == left[-1]).all()
    assert layers.plan_cells({}, areas, {}).lines == []


def test_clouds_are_thinned_and_placed_and_bad_ones_left_out() -> None:
    points = np.random.default_rng(1).uniform(-5, 5, (1000, 3)).astype(np.float32)
    payload = encode_cloud(PointCloud(points, np.zeros(1000, np.float32)), max_error_m=0.02)
    whole = SCAN.model_copy(
        update={
            "payload": np.frombuffer(payload, np.uint8),
            "sensor_pose": np.array([100.0, 0, 2, 0, 0, 0]),
        }
    )
    found = clouds([whole, SCAN.model_copy(update={"agent": "bad"})], most_points=300)
    assert [cloud.agent for cloud in found] == ["rsu-0"]
    assert found[0].sensor_m.tolist() == [100, 0, 2]
    assert len(found[0].points) == 250
    assert (np.abs(found[0].points - [100, 0, 2]) < 5.1).all()


def test_an_agent_keeps_its_colour_and_a_newcomer_gets_a_free_one() -> None:
    colours = Colours()
    first = colours.of(["a", "b"])
    assert len({*first.values()}) == 2
    later = colours.of(["c", "b"])
    assert later["b"] == first["b"]
    assert later["c"] == first["a"]
    assert colours.of(["a"])["a"] == first["a"]
    assert len(colours.of(map(str, range(500)))) == 500
    colours.of([])
    assert len(colours._numbers) == MAX_REMEMBERED


def test_the_road_has_a_surface_stop_bars_and_a_camera_above_it() -> None:
    road = surface(CROSSING)
    assert road.triangles.max() < len(road.vertices)
    a, b, c = (road.vertices[road.triangles[:, n]] for n in range(3))
    area_m2 = np.cross(b - a, c - a)[:, 2].sum() / 2
    assert area_m2 == pytest.approx(4 * 75 * 3)
    found = heads(CROSSING)
    assert found.lanes == ["south_0", "west_0"]
    assert found.bars[0][:, 1].tolist() == [-5, -5]
    look = camera(CROSSING)
    assert look.position[2] > look.target[2] + 10


def test_phases_are_named_by_who_gets_green() -> None:
    names = phase_names(CROSSING, CROSSING.intersections[0].signal)
    assert names == ["south", "west"]
    request = m.SignalRequest(
        frame=1, sim_time_ns=1, tls="J", state="Gr", policy="max_pressure", pressures=[3, 1]
    )
    assert pressures(request, names) == {"south": 3, "west": 1}
    assert pressures(request.model_copy(update={"pressures": [1.0]}), names) == {}


def test_the_score_of_a_moment_is_that_of_the_study() -> None:
    moment = Moment(1, detections=detections(), truth=truth())
    score = TruthScorer(CROSSING, {"car": CAR}).score(moment)
    assert score is not None
    assert (score.present, score.true) == (2, 1)
    assert TruthScorer(CROSSING, {}).score(Moment(1)) is None


def tracks_at(second: float, places: dict[int, float], **changes: object) -> m.Detections:
    count = len(places)
    boxes = np.array([[x, 0, 1, 4, 2, 1.5, 0] for x in places.values()], np.float32).reshape(-1, 7)
    known = tracked(count) | {"track_ids": np.array(list(places), np.int64)}
    plain = {
        "sim_time_ns": round(second * 1e9), "boxes": boxes, "scores": np.ones(count, np.float32),
        "classes": np.zeros(count, np.uint8), "lanes": ["south_0"] * count,
        "distances_m": np.ones(count, np.float32), "sources": ["lidar"] * count,
    }  # fmt: skip
    return detections(**(plain | known | changes))


def test_boxes_are_named_by_their_track_its_speed_and_whether_somebody_sees_it() -> None:
    known = {
        "speeds_mps": np.array([10, 2], np.float32), "coasted_s": np.array([0, 1.5], np.float32),
    }  # fmt: skip
    boxes = layers.detected(tracks_at(1, {7 + (3 << 50): 0.0, 9: 5.0}, **known), {})
    assert boxes.labels == ["#7 · south_0 · 36 km/h", "#9 · south_0 · 7 km/h · unseen for 1.5 s"]
    assert boxes.colours == [rgb(palette.BOX), rgb(palette.FAINT)]


def test_trails_reach_back_five_seconds_and_end_with_their_track() -> None:
    trails = layers.Trails()
    assert trails.of(tracks_at(0, {7: 0.0})).lines == []
    assert trails.of(tracks_at(1, {7: 1.0, 9: 50.0})).names == ["#7"]
    (line,) = trails.of(tracks_at(5.5, {7: 2.0})).lines
    assert line[:, 0].tolist() == [1.0, 2.0]  # that of 0 s is too old
    assert line[:, 2].tolist() == pytest.approx([0.45, 0.45])
    assert trails.of(tracks_at(6, {9: 51.0})).lines == []
