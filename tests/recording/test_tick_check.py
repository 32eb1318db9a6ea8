from contextlib import suppress

import pytest

from protocol.errors import MessageError
from recording.frame_aggregator import TickCheck

PERIOD_NS = 100


def followed(*ticks: tuple[int, int]) -> list[int]:
    """Returns the accepted frame after each tick."""
    check, frames = TickCheck(PERIOD_NS), []
    for frame, sim_time_ns in ticks:
        with suppress(MessageError):
            check.take(frame, sim_time_ns)
        frames.append(check.frame)
    return frames


def test_ticks_follow_each_other_even_where_some_are_missing():
    assert followed((0, 6000), (1, 6100), (4, 6395), (260, 32_000)) == [0, 1, 4, 260]


@pytest.mark.parametrize(
    "absurd", [(1 << 39, 6200), (2, 1 << 60), (300, 36_000), (1, 6100), (2, 0)]
)
def test_one_that_leads_elsewhere_does_not_move_it(absurd):
    assert followed((0, 6000), (1, 6100), absurd, (2, 6200)) == [0, 1, 1, 2]


def test_the_first_may_be_absurd_too():
    assert followed((1 << 39, 0), (0, 6000), (1, 6100)) == [-1, 0, 1]
    assert followed((0, 1 << 60), (0, 6000), (1, 6100)) == [0, 0, 1]


def test_two_that_follow_each_other_are_believed_so_that_a_long_gap_ends():
    assert followed((0, 0), (900, 90_000), (901, 90_100)) == [0, 0, 901]
