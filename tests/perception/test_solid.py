"""Boxes that no vehicle can be in."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perception.config import DetectionConfig
from perception.detector import Cloud
from perception.fast import FastDetector
from perception.roadway import Placed, Roadway
from perception.solid import are_open, are_seen, are_solid, observations_of
from protocol.messages import ObjectClass
from recording.foreign_scans.ground import Ground
from recording.foreign_scans.importer import open_ground

EYE = np.array([[0.0, 0.0, 2.0]])
LORRY = np.array([[0.0, 10.0, 1.7, 9.0, 2.5, 3.4, 0.0]])
CAR = np.array([[12.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.3]])
TRUCKS, CARS = np.array([ObjectClass.TRUCK], np.uint8), np.array([ObjectClass.CAR], np.uint8)

LEVEL = Ground(np.zeros((1, 2)), np.zeros((1, 3)), fit=1.0, slope_deg=0.0)


def upright(x, y, high_m, low_m=0.5):
    """Returns points (N, 3) that stand on a line in the plane, up to a height."""
    at = np.stack([np.asarray(x, float), np.broadcast_to(y, np.shape(x))], -1)
    levels = np.arange(low_m, high_m, 0.2)
    return np.concatenate([np.column_stack([at, np.full(len(at), z)]) for z in levels])


def solid(boxes, classes, *parts):
    return bool(are_solid(classes, observed(boxes, np.concatenate(parts)))[0])


def observed(boxes, points, sizes=None, eyes=EYE):
    sizes = np.array([len(points)] if sizes is None else sizes)
    return observations_of(boxes, *_cloud(points), sizes, eyes)


SIDE = upright(np.linspace(-4.4, 4.4, 60), 8.8, 3.4)
WALL = upright(np.linspace(-30, 30, 400), 16.0, 2.5)


def test_a_lorrys_side_is_solid_and_what_it_hides_is_no_matter():
    assert solid(LORRY, TRUCKS, SIDE)
    beside = np.abs(WALL[:, 0]) > 8.5 * 16 / 8.8
    assert solid(LORRY, TRUCKS, SIDE, WALL[beside])


def test_two_trunks_before_a_wall_are_no_lorry():
    trunks = upright([-4.0, 4.0], 9.5, 3.4)
    assert not solid(LORRY, TRUCKS, trunks, WALL)
    assert solid(LORRY, TRUCKS, trunks)  # nobody has looked through


def test_a_wall_that_goes_on_over_a_box_is_no_car_and_a_crown_over_one_is_air_apart():
    rear = upright(np.full(40, 9.9), np.linspace(-0.9, 0.9, 40), 1.5)
    assert solid(CAR, CARS, rear)
    assert not solid(CAR, CARS, upright(np.full(40, 9.9), np.linspace(-0.9, 0.9, 40), 4.5))
    assert solid(CAR, CARS, rear, upright(np.linspace(10, 14, 40), 0.3, 4.5, low_m=3.0))


def test_a_hedge_that_goes_on_beyond_a_box_is_no_car_and_a_queue_of_cars_is_no_hedge():
    box = np.array([[0.0, 6.0, 0.75, 4.5, 1.8, 1.5, 0.0]])
    hedge = upright(np.linspace(-2.2, 5.5, 80), 5.2, 1.6)
    assert not solid(box, CARS, hedge)
    assert solid(box, CARS, hedge[np.abs(hedge[:, 0]) < 2.2])
    body = upright(np.linspace(-2.2, 2.2, 60), 5.2, 0.8)
    cabin = upright(np.linspace(-1.3, 1.0, 30), 5.2, 1.5, low_m=0.8)
    queue = [
        np.add(part, [ahead_m, 0, 0]) for part in (body, cabin) for ahead_m in (-4.6, 0.0, 4.6)
    ]
    assert solid(box, CARS, *queue)


def test_a_back_that_is_seen_through_the_near_side_is_a_bus_shelter_and_not_a_van():
    box = np.array([[0.0, 6.0, 1.1, 5.0, 2.0, 2.2, 0.0]])
    near, back = (upright(np.linspace(-2.3, 2.3, 60), y, 2.2) for y in (5.05, 6.9))
    people = np.array([ObjectClass.PEDESTRIAN], np.uint8)
    for classes, points, is_open in (
        (CARS, near, False),
        (CARS, back, True),
        (TRUCKS, back, True),
        (people, back, False),
        (CARS, np.concatenate([near, back[:200]]), False),  # through its windows, say
        (CARS, back[:4], False),
    ):
        assert are_open(classes, observed(box, points)).tolist() == [is_open]


def test_a_lorry_may_be_longer_than_its_box_beyond_one_end_alone():
    longer = upright(np.linspace(-4.4, 7.4, 90), 8.8, 3.4)
    assert solid(LORRY, TRUCKS, longer)
    assert not solid(LORRY, TRUCKS, upright(np.linspace(-7.4, 7.4, 120), 8.8, 3.4))


def test_what_one_sees_through_a_gap_of_a_wall_is_too_little_for_a_car():
    rear = upright(np.full(60, 9.9), np.linspace(-0.9, 0.9, 60), 1.5)
    wall = upright(np.full(200, 6.0), np.linspace(-1.5, 1.5, 200), 2.0)
    past_gap = np.abs(rear[:, 1]) < 0.05
    assert are_seen(observed(CAR, rear)).tolist() == [True]
    assert past_gap.sum() >= 5
    assert are_seen(observed(CAR, np.concatenate([wall, rear[past_gap]]))).tolist() == [False]
    assert are_seen(observed(CAR, rear[:4])).tolist() == [False]
    # Another sensor sees all of it.
    both, eyes = np.concatenate([wall, rear]), np.array([*EYE, [20.0, 3.0, 2.0]])
    assert are_seen(observed(CAR, both, [len(wall), len(rear)], eyes)).tolist() == [True]


def test_a_person_may_be_looked_past():
    person = np.array([[8.0, 0.0, 0.85, 0.5, 0.6, 1.7, 0.0]])  # the sensor looks down on it
    people = np.array([ObjectClass.PEDESTRIAN], np.uint8)
    behind = upright(np.full(40, 9.0), np.linspace(-0.2, 0.2, 40), 1.0)
    assert solid(person, people, behind)
    assert not solid(person, CARS, behind)


def test_without_boxes_or_points_there_is_nothing_to_mark():
    nothing = observed(CAR, np.zeros((0, 3)))
    assert are_solid(CARS, nothing).tolist() == [True]
    assert are_seen(nothing).tolist() == [False]
    assert len(are_solid(CARS[:0], observed(CAR[:0], np.zeros((0, 3))))) == 0


@given(st.floats(-np.pi, np.pi), st.integers(0, 2**32 - 1))
def test_counts_turn_with_the_scene_and_add_up_over_parts(turn, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-20, -20, 0], [20, 20, 4], (400, 3))
    boxes = np.array([*LORRY, *CAR])
    whole = observed(boxes, points).counts
    parts = observed(boxes, points, [150, 250], np.repeat(EYE, 2, 0)).counts
    assert (whole == parts).all()
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    turned = boxes.copy()
    turned[:, :3] = boxes[:, :3] @ rotation.T
    turned[:, 6] += turn
    again = observed(turned, points @ rotation.T).counts
    assert np.abs(whole - again).max() <= 1  # of points on an edge, by rounding


def _cloud(points):
    return points.astype(np.float32), points[:, 2].astype(np.float32)


def test_a_sensor_is_taken_to_be_on_a_roof_at_least():
    behind = upright(np.full(40, 20.0), np.linspace(-0.5, 0.5, 40), 1.2)
    eyes = [np.array([[0.0, 0.0, eye_m]]) for eye_m in (0.3, 1.5)]
    counts = [observed(CAR, behind, eyes=eye).counts for eye in eyes]
    assert counts[0][0, 1] == counts[1][0, 1] > 30


def test_fast_leaves_out_what_it_looks_through_if_it_is_asked_to():
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-20, 20, (8000, 2)), rng.normal(0, 0.02, 8000)])
    hedge = rng.uniform([8, -2, 0.3], [9, 2, 1.2], (150, 3))
    behind = upright(np.full(300, 15.0), np.linspace(-3, 3, 300), 1.0)
    way = {"way": np.array([[0, 0, 0, 0, 0, np.pi / 2]])}
    roadway = Roadway.of(open_ground(way, LEVEL, width_m=40), margin_m=0.5)
    points = np.concatenate([ground, hedge, behind]).astype(np.float32)
    placed = Placed.of(points, np.zeros(len(points), np.float32))
    found = {}
    for only in (False, True):
        detector = FastDetector(DetectionConfig(solid_only=only), roadway)
        boxes = detector.detect(Cloud([placed], [], EYE), np.random.default_rng(1)).boxes
        found[only] = int((np.hypot(boxes[:, 0] - 8.5, boxes[:, 1]) < 2).sum())
    assert found == {False: 1, True: 0}
