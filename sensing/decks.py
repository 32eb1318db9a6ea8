"""Bridge decks: where lanes pass over other lanes, and so have a surface of their own.

A lane that rises from an embankment needs as much room beside it as the embankment is wide. Where
that room is another lane's, and the two cross nearby, it stands on a deck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from protocol.geometry import Floats
from protocol.roadmap import Lane
from sensing.mesh import TriangleMesh, strip
from sensing.road import heights_along, resample

SAMPLE_M = 3.0
REACH_M = 9.0  # a lane's height counts for the ground so near it
CLEARANCE_M = 3.5  # a lane that is so much higher passes over the other
BANK = 1.5  # metres that an embankment is wide for each that it is high
RUN_UP_M = 12.0  # a deck goes on over the ground so far, at the same height
BESIDE_M = 0.75  # it is so much wider than its lanes
THICK_M = 0.8
_NEAR_M = 48.0  # of a crossing: there lanes are on decks; and the squares that are searched
_AROUND = list(product((-1, 0, 1), repeat=2))

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class LanePlaces:
    """Places on lanes: x, y, z (N, 3), lane (N,) and half its width (N,), lane by lane."""

    points: Floats
    lane: Ints
    half_m: Floats

    @classmethod
    def of(cls, lanes: Sequence[Lane]) -> LanePlaces:
        """Returns places every 3 m."""
        flat = [resample(lane.points[:, :2], SAMPLE_M) for lane in lanes]
        points = [
            np.column_stack([xy, heights_along(xy, lane.points)])
            for xy, lane in zip(flat, lanes, strict=True)
        ]
        counts = [len(xy) for xy in flat]
        half_m = np.array([lane.width_m / 2 for lane in lanes])
        number = np.arange(len(lanes))
        return cls(np.concatenate(points), number.repeat(counts), half_m.repeat(counts))

    def take(self, chosen: Bools) -> LanePlaces:
        """Returns some of them, by mask."""
        return LanePlaces(self.points[chosen], self.lane[chosen], self.half_m[chosen])

    def runs(self) -> list[LanePlaces]:
        """Returns the places of each lane that follow one another."""
        apart_m = np.hypot(*np.diff(self.points[:, :2], axis=0).T)
        is_cut = (np.diff(self.lane) != 0) | (apart_m > 1.5 * SAMPLE_M)
        return [self.take(part) for part in _parts(is_cut)]


def _parts(is_cut: Bools) -> list[Bools]:
    number = np.concatenate([[0], np.cumsum(is_cut)])
    return [number == n for n in range(number[-1] + 1)]


def by_level(places: LanePlaces) -> tuple[LanePlaces, list[LanePlaces]]:
    """Returns the places on the ground, and those of the decks of each level above it.

    A deck has its run-ups too: places that are on the ground as well.
    """
    level = np.zeros(len(places.points), np.int64)
    members = np.arange(len(level))
    while len(members) and (over := _passes_over(places, members)).any():
        members = members[over]
        level[members] += 1
    decks = [
        places.take((level == above) | _runs_up(places, level == above, level < above))
        for above in range(1, int(level.max(initial=0)) + 1)
    ]
    return places.take(level == 0), decks


def _passes_over(places: LanePlaces, members: Ints) -> Bools:
    """Whether places, of those with these numbers (M,), are on decks over others of them."""
    points, half_m = places.points[members], places.half_m[members]
    if np.ptp(points[:, 2]) <= CLEARANCE_M:
        return np.zeros(len(members), np.bool_)
    squares = _squares(points)
    lacks_room, crosses = np.zeros((2, len(members)), np.bool_)
    for own, around in squares:
        rise_m, away_m = _apart(points[own], points[around])
        is_over = rise_m > CLEARANCE_M
        lacks_room[own] = (is_over & (away_m < 2 * REACH_M + BANK * rise_m)).any(axis=1)
        crosses[own] = (is_over & (away_m < half_m[own, None] + half_m[around])).any(axis=1)
    result = np.zeros(len(members), np.bool_)
    for own, around in squares:
        rise_m, away_m = _apart(points[own], points[around])
        beside = (np.abs(rise_m) < CLEARANCE_M) & (away_m < _NEAR_M) & crosses[around]
        result[own] = lacks_room[own] & beside.any(axis=1)
    return result


def _runs_up(places: LanePlaces, on_deck: Bools, below: Bools) -> Bools:
    """Whether places below a deck's level lead up to it."""
    result = np.zeros(len(on_deck), np.bool_)
    for own, around in _squares(places.points):
        deck = around[on_deck[around]]
        rise_m, away_m = _apart(places.points[own], places.points[deck])
        leads = (away_m < RUN_UP_M) & (np.abs(rise_m) < CLEARANCE_M / 2)
        result[own] = below[own] & leads.any(axis=1)
    return result


def _squares(points: Floats) -> list[tuple[Ints, Ints]]:
    """Returns the numbers of the points in each square of the plane, and of those around it."""
    squares: dict[tuple[int, int], list[int]] = {}
    for number, (i, j) in enumerate(np.floor(points[:, :2] / _NEAR_M).astype(int).tolist()):
        squares.setdefault((i, j), []).append(number)
    return [
        (
            np.array(own),
            np.concatenate(
                [np.array(squares.get((i + di, j + dj), []), int) for di, dj in _AROUND]
            ),
        )
        for (i, j), own in squares.items()
    ]


def _apart(points: Floats, others: Floats) -> tuple[Floats, Floats]:
    """Returns how much higher points (N, 3) are than others (M, 3), and how far away (N, M)."""
    x, y, z = (points[:, None, axis] - others[None, :, axis] for axis in range(3))
    return z, np.hypot(x, y)


def deck_mesh(run: LanePlaces, top_m: Floats) -> TriangleMesh:
    """Returns the slab below one lane's places, whose top is at these heights (N,)."""
    if len(run.points) < 2:
        return TriangleMesh.of(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    along = np.gradient(run.points[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]]) * (run.half_m[:, None] + BESIDE_M)
    corners = ((1, 0.0), (-1, 0.0), (-1, -THICK_M), (1, -THICK_M), (1, 0.0))
    sections = np.empty((len(run.points), len(corners), 3))
    for k, (side, up_m) in enumerate(corners):
        sections[:, k, :2] = run.points[:, :2] + side * left
        sections[:, k, 2] = top_m + up_m
    return strip(sections)
