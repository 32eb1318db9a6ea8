"""Classes of objects by their shape, and the sizes that objects of a class usually have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.arrays import Bools, Bytes, Floats, Ints
from protocol.messages import ObjectClass

LONGEST_VEHICLE_M = 18.75  # of a road train (Directive 96/53/EC); an articulated bus has 18 m
WIDEST_VEHICLE_M = 3.2  # 2.55 m of a lorry, and its mirrors
HIGHEST_VEHICLE_M = 4.3  # 4 m are allowed (Directive 96/53/EC)
VAN_TOP_M = 1.8  # what is higher is a van, upright at its rear, with a short bonnet, or larger
TALL_M = 2.2  # what is higher is a large van, a lorry or a bus
HIGH_M = 2.9  # what is higher is a lorry or a bus, however short
LONG_M = 7.2  # what is longer is, however low
RIDER_TOP_M, PERSON_TOP_M = 1.35, 1.5  # what is lower is a part of a car
POLE_M = 0.9  # what is tall and has a smaller footprint is a pole
MAST_M = 1.5  # the same of what is higher than vans, with signals or signs on it
THIN_M = 0.5  # what is long, low and thinner is a wall

# Usual length, width and height in m, by what is to be completed to them.
_USUAL_M = np.array(
    [
        [4.5, 1.8, 1.5],  # car
        [4.9, 1.9, 1.95],  # van, which is a car, too
        [5.6, 2.1, 2.4],  # large van, which is one as well
        [9.0, 2.5, 3.2],  # truck
        [1.9, 0.7, 1.65],  # two-wheeler
        [0.5, 0.6, 1.7],  # pedestrian
    ]
)
# Of cars, by the width that is seen: a usual one, the narrowest; less than that is a part.
# Lengths are those of the line of least squares through thirty models on sale.
_NARROW_M = np.array(
    [
        [1.5, 1.65, 1.815],  # seen
        [4.5, 3.6, 4.5],  # length: 4.42 + 5.47 (width - 1.8)
        [1.8, 1.65, 1.8],  # width
    ]
)
_CAR, _VAN, _LARGE_VAN, _TRUCK, _TWO_WHEELER, _PEDESTRIAN = range(6)
_CLASSES = np.array(
    [
        ObjectClass.CAR,
        ObjectClass.CAR,
        ObjectClass.CAR,
        ObjectClass.TRUCK,
        ObjectClass.TWO_WHEELER,
        ObjectClass.PEDESTRIAN,
    ],
    np.uint8,
)


PASSENGER_CAR_UNITS = {
    ObjectClass.CAR: 1.0,
    ObjectClass.TRUCK: 2.0,
    ObjectClass.TWO_WHEELER: 0.4,
    ObjectClass.PEDESTRIAN: 0.0,
}
"""Road space that a vehicle takes, as a car's: of buses and motorcycles those of Transport for
London's Traffic Modelling Guidelines; a lorry's there are 1.5 to 2.3, a bicycle's 0.2."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Measured sizes of objects: along and across the road, and over the ground (C,), m."""

    along_m: Floats
    across_m: Floats
    bottom_m: Floats
    top_m: Floats

    @property
    def is_vehicle_or_person(self) -> Bools:
        """Whether an object may be one, (C,)."""
        long_m = np.maximum(self.along_m, self.across_m)
        wide_m = np.minimum(self.along_m, self.across_m)
        fits = (
            (long_m <= LONGEST_VEHICLE_M)
            & (wide_m <= WIDEST_VEHICLE_M)
            & (self.top_m <= HIGHEST_VEHICLE_M)
        )
        is_pole = (long_m < POLE_M) & (self.top_m > TALL_M)
        is_pole |= (long_m < MAST_M) & (self.top_m > HIGH_M)
        is_crown = self.bottom_m > TALL_M
        is_wall = (long_m > LONG_M) & (self.top_m < TALL_M) & (wide_m < THIN_M)
        return np.asarray(fits & ~is_pole & ~is_crown & ~is_wall)

    def kinds(self) -> Ints:
        """Returns what each is, an index into the usual sizes (C,)."""
        long_m = np.maximum(self.along_m, self.across_m)
        kinds = np.full(len(self.top_m), _CAR, np.int64)
        kinds[self.top_m > VAN_TOP_M] = _VAN
        kinds[self.top_m > TALL_M] = _LARGE_VAN
        kinds[(self.top_m > HIGH_M) | (long_m > LONG_M)] = _TRUCK
        is_upright = (self.top_m > RIDER_TOP_M) & (self.top_m < TALL_M) & (self.bottom_m < 0.8)
        is_narrow = (self.across_m < 1.1) & (self.along_m < 2.8)
        kinds[is_upright & is_narrow] = _TWO_WHEELER
        kinds[is_upright & (long_m <= 0.9) & (self.top_m > PERSON_TOP_M)] = _PEDESTRIAN
        return kinds


def classes_of(kinds: Ints) -> Bytes:
    """Returns the `ObjectClass` (C,) of what `Shapes.kinds` returned."""
    return np.asarray(_CLASSES[kinds])


def is_car(kinds: Ints) -> Bools:
    """Marks cars and vans, but for large ones (C,), of what `Shapes.kinds` returned."""
    return np.asarray((kinds == _CAR) | (kinds == _VAN))


def is_van(kinds: Ints) -> Bools:
    """Marks the vans, but for large ones (C,), of what `Shapes.kinds` returned."""
    return np.asarray(kinds == _VAN)


def usual_m(kinds: Ints) -> Floats:
    """Returns the usual length, width and height in m (C, 3)."""
    return np.asarray(_USUAL_M[kinds])


def car_sizes_m(widths_m: Floats) -> Floats:
    """Returns the usual lengths and widths (C, 2) of cars that look so wide: narrow ones are short.

    What looks narrower than any car is hidden at one side, and may be as long as most; what looks
    wider is turned, or seen by two sensors that do not agree.
    """
    seen_m, *sizes_m = _NARROW_M
    return np.column_stack([np.interp(widths_m, seen_m, size_m) for size_m in sizes_m])


def classes_by_size(sizes_m: Floats) -> Bytes:
    """Returns the `ObjectClass` (N,) that fits boxes of length, width and height in m (N, 3)."""
    along_m, across_m, top_m = np.asarray(sizes_m, np.float64).reshape(-1, 3).T
    return classes_of(Shapes(along_m, across_m, np.zeros(len(top_m)), top_m).kinds())


def passenger_car_units(classes: Bytes) -> Floats:
    """Returns the passenger-car units (N,) of vehicles of these classes (N,)."""
    table = np.array([PASSENGER_CAR_UNITS[one] for one in sorted(ObjectClass)])
    return np.asarray(table[classes])
