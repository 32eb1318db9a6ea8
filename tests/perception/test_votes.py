"""The lowest point of each square metre, against a search by hand."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perception.votes import lowest


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 200), reach_m=st.floats(0.1, 30))
def test_each_square_metre_has_its_lowest_point(seed: int, count: int, reach_m: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach_m, reach_m, (count, 3)).astype(np.float32)
    base_m = rng.uniform(-1, 1, count).astype(np.float32)
    over_m = points[:, 2] - base_m
    by_hand: dict[tuple[int, int], float] = {}
    for (x, y), height_m in zip(np.floor(points[:, :2]).astype(int), over_m, strict=True):
        by_hand[x, y] = min(by_hand.get((x, y), np.inf), float(height_m))
    votes = lowest(points, base_m)
    cells = [(int(x), int(y)) for x, y in np.floor(votes[:, :2])]
    assert dict(zip(cells, votes[:, 2].tolist(), strict=True)) == by_hand
    assert len(set(cells)) == len(cells)


def test_parts_votes_together_are_those_of_the_whole() -> None:
    points = np.random.default_rng(2).uniform(-9, 9, (900, 3)).astype(np.float32)
    none = np.zeros(900, np.float32)
    parts = [lowest(points[a : a + 300], none[:300]) for a in (0, 300, 600)]
    votes = np.concatenate(parts)
    np.testing.assert_array_equal(lowest(votes, none[: len(votes)]), lowest(points, none))
