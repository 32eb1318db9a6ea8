"""Classes by shape."""

import numpy as np
import pytest

from perception.object_classes import Shapes, classes_by_size, classes_of, usual_m
from protocol.messages import ObjectClass


def shapes(along_m: float, across_m: float, bottom_m: float, top_m: float) -> Shapes:
    return Shapes(*(np.array([value]) for value in (along_m, across_m, bottom_m, top_m)))


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((4.5, 1.8, 1.5), ObjectClass.CAR),
        ((6.0, 2.1, 2.6), ObjectClass.CAR),
        ((8.5, 2.5, 3.4), ObjectClass.TRUCK),
        ((16.5, 2.55, 4.0), ObjectClass.TRUCK),
        ((12.0, 2.55, 2.0), ObjectClass.TRUCK),
        ((2.2, 0.8, 1.6), ObjectClass.TWO_WHEELER),
        ((1.8, 0.65, 1.75), ObjectClass.TWO_WHEELER),
        ((0.4, 0.6, 1.75), ObjectClass.PEDESTRIAN),
    ],
)
def test_what_is_seen_whole_gets_its_class(size, expected):
    assert classes_by_size(np.array([size])).tolist() == [expected]


@pytest.mark.parametrize("part", [(0.2, 1.7, 0.3, 1.3), (2.0, 0.4, 0.3, 1.2), (0.6, 0.6, 0.2, 1.2)])
def test_a_part_of_a_car_is_a_car(part):
    shape = shapes(*part)
    assert classes_of(shape.kinds()).tolist() == [ObjectClass.CAR]
    assert usual_m(shape.kinds())[0].tolist() == [4.5, 1.8, 1.5]


@pytest.mark.parametrize(
    ("top_m", "length_m"), [(1.5, 4.5), (1.75, 4.5), (1.95, 4.9), (2.5, 5.6), (3.2, 9.0)]
)
def test_the_usual_length_goes_by_the_height(top_m, length_m):
    assert usual_m(shapes(2.0, 1.8, 0.3, top_m).kinds())[0, 0] == length_m


@pytest.mark.parametrize(
    "thing",
    [
        (0.2, 0.2, 0.2, 3.0),  # a pole
        (3.0, 2.0, 2.6, 3.9),  # a tree's crown
        (20.0, 2.5, 0.2, 3.4),  # longer than any vehicle
        (6.0, 4.0, 0.2, 3.0),  # wider
        (9.0, 0.3, 0.1, 0.6),  # a low wall
        (4.0, 2.0, 0.2, 5.0),  # higher
    ],
)
def test_what_no_vehicle_can_be_is_left_out(thing):
    assert not shapes(*thing).is_vehicle_or_person[0]
