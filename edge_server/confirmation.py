"""Whether what one agent shows is confirmed by the others that look at the same places.

Each square that an agent shows as taken is asked of all others: those who show something there or
beside it agree, those who see the road there or through it do not. What it shows as free is asked
only of those who show something there. A square that nobody else sees says nothing, nor does one
where word stands against word: two vehicles that contradict each other need a third. A post, whose
place was surveyed, weighs more than all vehicles together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from edge_server.views import Squares, View
from perception.arrays import Floats, Floats32, Ints, Ints32
from protocol.messages import AgentPose

OWN_WEIGHT = 1.0  # of an agent's own word
POST_WEIGHT = 4.0
CROWD_WEIGHT = 1.5  # of all vehicles together where a post looks as well
NOSE_M, SIDE_M = 1.5, 1.2  # of a vehicle's length and width: its ends may be seen as road
PLACE_STD, MOST_PLACE_M = 2.5, 5.0  # standard deviations by which a vehicle may be off
_LEAST = 1e-3  # of a weight that counts: sums of weights are not exact
_RASTER = "Tuple((int32[::1], int32[::1], int64))"
_BOARDS = "Tuple((float32[:,::1], float32[:,::1], float32[:,::1]))"
_VIEW = "Tuple((int32[::1], int32[::1]))"

Raster = tuple[Ints32, Ints32, int]
Boards = tuple[Floats32, Floats32, Floats32]


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """What an agent shows, and how much it is believed: 1 fully, 0 not at all."""

    view: View
    is_post: bool
    belief: float

    @property
    def weight(self) -> float:
        """How much its word counts."""
        return self.belief * (POST_WEIGHT if self.is_post else 1.0)


@dataclass(frozen=True, slots=True)
class Confirmed:
    """Of an agent's squares that others see as well: how many, and the sum of what they say.

    Each says 1 if all agree, and the less the more of them contradict.
    """

    squares: int
    total: float


class Confirmation:
    """Lays agents' views over one another; keeps the memory that it takes."""

    def __init__(self, squares: Squares) -> None:
        self._squares = squares
        self._raster = squares.number, squares.at, squares.columns
        # By square, for vehicles and for posts: how much is said for its being taken, or the one
        # beside it; for its being free; for its being taken itself.
        near, free, taken = (np.zeros((2, len(squares)), np.float32) for _ in range(3))
        self._boards = near, free, taken
        self._mark = np.full(len(squares), -1, np.int32)

    def weigh(self, witnesses: Sequence[Witness]) -> list[Confirmed]:
        """Returns for each what the others say of it; the order is no matter."""
        for board in self._boards:
            board[:] = 0
        self._mark[:] = -1
        for index, one in enumerate(witnesses):
            who = np.array([index, int(one.is_post)])
            view = one.view.taken, one.view.free
            _lay(view, who, one.weight, self._raster, self._boards, self._mark)
        return [self._confirmed(one) for one in witnesses]

    def seen_through(self, pose: AgentPose, weight: float) -> float:
        """Returns how much of a vehicle's place others show to be free: 0 to 1.

        Of all places on the road where it may be within its error, the one that is contradicted
        least; 0 if there is none, or if it may be anywhere. `weight` is that of its own word.
        """
        x, y, yaw_rad = pose.pose[[0, 1, 5]].tolist()
        far_m = PLACE_STD * pose.position_std_m
        if far_m > MOST_PLACE_M:
            return 0.0
        size_m = max(pose.length_m - NOSE_M, 0.0), max(pose.width_m - SIDE_M, 0.0)
        body = np.array([x, y, yaw_rad, *size_m, float(round(far_m))])
        return float(_through(body, weight, self._squares.grid, self._raster, self._boards))

    def _confirmed(self, one: Witness) -> Confirmed:
        own = np.zeros(2)
        own[int(one.is_post)] = one.weight
        view = one.view.taken, one.view.free
        count, total = _ask(view, own, self._boards)
        return Confirmed(count, total)


@njit(
    f"void({_VIEW}, int64[::1], float64, {_RASTER}, {_BOARDS}, int32[::1])",
    cache=True,
    nogil=True,
)
def _lay(
    view: tuple[Ints32, Ints32],
    who: Ints,
    weight: float,
    raster: Raster,
    boards: Boards,
    mark: Ints32,
) -> None:
    """Adds an agent's word to the boards; `who` is its index and its kind."""
    taken, free = view
    number, at, columns = raster
    near, clear, exact = boards
    index, kind = who
    for place in range(taken.size):
        middle = at[taken[place]]
        exact[kind, taken[place]] += weight
        for row in range(-1, 2):
            for column in range(-1, 2):
                spot = middle + row * columns + column
                beside = number[spot] if 0 <= spot < number.size else -1
                if beside >= 0 and mark[beside] != index:
                    mark[beside] = index
                    near[kind, beside] += weight
    for place in range(free.size):
        clear[kind, free[place]] += weight


@njit("float64(float64[::1], float64[::1])", cache=True, nogil=True)
def _verdict(agreeing: Floats, contrary: Floats) -> float:
    """Returns the share of the weight that agrees, one's own word included.

    1 unless the others weigh more: word against word proves nothing.
    """
    crowd = agreeing[0] + contrary[0]
    scale = 1.0
    if agreeing[1] + contrary[1] > _LEAST and crowd > CROWD_WEIGHT:
        scale = CROWD_WEIGHT / crowd
    agree = OWN_WEIGHT + scale * agreeing[0] + agreeing[1]
    against = scale * contrary[0] + contrary[1]
    return 1.0 if against <= agree + _LEAST else agree / (agree + against)


@njit(f"float64(float64[::1], float64, float64[::1], {_RASTER}, {_BOARDS})", cache=True, nogil=True)
def _through(body: Floats, weight: float, grid: Floats, raster: Raster, boards: Boards) -> float:
    """Returns the least share of a body, wherever it may be, that is contradicted.

    A body is x, y, yaw, length, width, and how far it may be off along x and y.
    """
    number, _, columns = raster
    x, y, yaw_rad, length_m, width_m, far_m = body
    cos, sin, least, most = np.cos(yaw_rad), np.sin(yaw_rad), 2.0, int(2 * far_m) + 1
    for place in range(most * most):
        move_x, move_y = place // most - far_m, place % most - far_m
        against = 0.0
        for point in range(12):
            along, across = (point // 3 / 3 - 0.5) * length_m, (point % 3 / 2 - 0.5) * width_m
            column = (x + move_x + cos * along - sin * across - grid[0]) * grid[2]
            row = (y + move_y + sin * along + cos * across - grid[1]) * grid[2]
            inside = 0 <= column < grid[3] and 0 <= row < grid[4]
            square = number[int(row) * columns + int(column)] if inside else -1
            if square < 0:
                against = 2.0 * 12
                break
            near = boards[0][0, square] + boards[0][1, square]
            free = boards[1][0, square] + boards[1][1, square]
            against += free / (weight + near + free) if free > _LEAST else 0.0
        least = min(least, against / 12)
    return 0.0 if least > 1 else least


@njit(
    f"Tuple((int64, float64))({_VIEW}, float64[::1], {_BOARDS})",
    cache=True,
    nogil=True,
)
def _ask(view: tuple[Ints32, Ints32], own: Floats, boards: Boards) -> tuple[int, float]:
    """Returns how many squares others see as well, and the sum of their verdicts."""
    taken, free = view
    near, clear, exact = boards
    count, total = 0, 0.0
    agreeing, contrary = np.zeros(2), np.zeros(2)
    for place in range(taken.size):
        for kind in range(2):
            agreeing[kind] = max(near[kind, taken[place]] - own[kind], 0.0)
            contrary[kind] = clear[kind, taken[place]]
        if agreeing.sum() + contrary.sum() > _LEAST:
            count += 1
            total += _verdict(agreeing, contrary)
    for place in range(free.size):
        for kind in range(2):
            agreeing[kind] = max(clear[kind, free[place]] - own[kind], 0.0)
            contrary[kind] = exact[kind, free[place]]
        if contrary.sum() > _LEAST:
            count += 1
            total += _verdict(agreeing, contrary)
    return count, total
