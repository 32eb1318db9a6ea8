"""Classes by shape."""

import numpy as np
import pytest

from perception.object_classes import Shapes, car_sizes_m, classes_by_size, classes_of, usual_m
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


MODELS_M = [
    *((3.47, 1.62), (3.57, 1.63), (3.60, 1.65), (3.65, 1.64), (3.67, 1.68), (3.94, 1.75)),
    *((4.04, 1.74), (4.05, 1.80), (4.06, 1.77), (4.07, 1.75), (4.28, 1.79), (4.36, 1.81)),
    *((4.37, 1.79), (4.37, 1.81), (4.38, 1.83), (4.39, 1.81), (4.49, 1.84), (4.54, 1.76)),
    *((4.55, 1.80), (4.69, 1.83), (4.69, 1.85), (4.69, 1.90), (4.71, 1.83), (4.75, 1.82)),
    *((4.77, 1.83), (4.87, 1.85), (4.89, 1.84), (4.90, 1.86), (4.94, 1.87), (4.94, 1.89)),
]
"""Length and width without mirrors: Peugeot 108, Fiat 500, VW up!, Fiat Panda, Hyundai i10, Toyota
Yaris, Ford Fiesta, Renault Clio, Opel Corsa, VW Polo, VW Golf, Renault Megane, Toyota Corolla, Opel
Astra, Ford Focus, Nissan Qashqai, VW Tiguan, Toyota Prius, Honda Civic, Skoda Octavia, Tesla
Model 3, Volvo XC60, BMW 3 Series, Mercedes C-Class, VW Passat, Ford Mondeo, Toyota Camry, Honda
Accord, BMW 5 Series, Audi A6."""


def test_lengths_by_width_are_those_of_cars_on_sale():
    length_m, width_m = np.array(MODELS_M).T
    slope, at_1_8_m = np.polyfit(width_m - 1.8, length_m, 1)
    narrow_m = np.array([1.66, 1.7, 1.75, 1.8])
    expected_m = at_1_8_m + slope * (narrow_m - 1.8)
    np.testing.assert_allclose(car_sizes_m(narrow_m)[:, 0], expected_m, atol=0.05)


def test_sizes_by_width_have_no_steps():
    seen_m = np.linspace(1.3, 2.1, 801)
    steps_m = np.abs(np.diff(car_sizes_m(seen_m), axis=0))
    assert steps_m.max() < 0.01
    assert car_sizes_m(np.array([1.4, 1.9])).tolist() == [[4.5, 1.8]] * 2
