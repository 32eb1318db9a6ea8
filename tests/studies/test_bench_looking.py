"""What looking on costs is told from the same frames of two runs."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.bench_looking import SETTLES_FRAMES, WatchedRun, row_of

FRAMES = 40


def watched(looked: Iterable[int], stretches_s: list[float], slow: float = 1.0) -> WatchedRun:
    """Returns a run whose frames take so long in each stretch, and `slow` times that if looked at.

    The first frames of each stretch are those of a change: they take a second.
    """
    looked = frozenset(looked)
    took_s = []
    for number, frame_s in enumerate(stretches_s):
        took_s += [1.0] * SETTLES_FRAMES
        took_s += [frame_s * (slow if number in looked else 1.0)] * (FRAMES - SETTLES_FRAMES)
    ticks = np.cumsum([0.0, *took_s, 1.0])
    return WatchedRun((ticks * 1e9).astype(np.int64), looked)


@given(
    st.lists(st.floats(0.01, 1), min_size=2, max_size=8).filter(lambda s: len(s) % 2 == 0),
    st.floats(0.5, 2),
    st.floats(1, 3),
)
def test_neither_what_is_seen_nor_the_machine_of_a_run_counts(stretches_s, machine, slow):
    even, odd = range(0, len(stretches_s), 2), range(1, len(stretches_s), 2)
    first = watched(even, stretches_s, slow)
    second = watched(odd, [machine * frame_s for frame_s in stretches_s], slow)
    row = row_of("record", [(first, second)], FRAMES)
    assert row.pairs == len(stretches_s) // 2
    assert (row.low, row.share, row.high) == pytest.approx([1 / slow] * 3, rel=1e-5)


def test_the_rate_alone_is_that_of_who_was_not_looked_on_at() -> None:
    first, second = watched([0], [0.05, 0.05], 2), watched([1], [0.1, 0.1], 2)
    assert row_of("web", [(first, second)], FRAMES).alone_hz == pytest.approx(1 / 0.075)


def test_what_was_looked_on_at_in_both_runs_or_in_none_does_not_count() -> None:
    times = [0.05] * 8
    first, second = watched([0, 2, 3, 6], times), watched([1, 3, 4, 7], times)
    row = row_of("web", [(first, second)], FRAMES)
    assert row.pairs == 2


def test_a_run_that_broke_off_counts_as_far_as_it_went() -> None:
    times = [0.05] * 4
    first, second = watched([0, 2], times), watched([1], times[:2])
    assert row_of("web", [(first, second)] * 3, FRAMES).pairs == 3
    nothing = row_of("web", [(first, watched([], []))], FRAMES)
    assert nothing.pairs == 0
    assert math.isnan(nothing.share)


def test_the_interval_is_of_the_median() -> None:
    runs = [
        (watched([0], [0.05] * 2, slow), watched([1], [0.05] * 2, slow))
        for slow in np.linspace(1, 1.2, 20)
    ]
    row = row_of("web", runs, FRAMES)
    assert 0.83 < row.low < row.share < row.high < 1
    assert row_of("web", runs, FRAMES) == row
    assert row.as_json()["way"] == "web"
