"""The clock of frames in realtime: never early, whatever the load."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from sim_host.role import FrameClock

PERIOD_NS = 50_000_000
LATENESS_NS = st.lists(st.integers(0, 3 * PERIOD_NS), min_size=2, max_size=60)


def begins_ns(lateness_ns: list[int]) -> list[int]:
    """Returns when frames begin of which each is as late as given, if it can be in time at all."""
    clock, now_ns, begins = FrameClock(PERIOD_NS), 1_000, []
    for late_ns in lateness_ns:
        now_ns += clock.wait_ns(now_ns) + late_ns
        clock.begin_frame(now_ns)
        begins.append(now_ns)
    return begins


@given(LATENESS_NS)
def test_no_frame_begins_before_its_time_after_the_first(lateness_ns: list[int]) -> None:
    first_ns, *others_ns = begins_ns(lateness_ns)
    for frame, begin_ns in enumerate(others_ns, 1):
        assert begin_ns >= first_ns + frame * PERIOD_NS


@given(LATENESS_NS)
def test_frames_hurry_by_less_than_a_period_after_any_other(lateness_ns: list[int]) -> None:
    begins = begins_ns(lateness_ns)
    for first, first_ns in enumerate(begins):
        for frame in range(first + 1, len(begins)):
            assert begins[frame] - first_ns > (frame - first - 1) * PERIOD_NS


def test_a_frame_less_than_a_period_late_delays_no_other() -> None:
    first_ns, late_ns, *others_ns = begins_ns([0, PERIOD_NS - 1, 0, 0])
    assert late_ns == first_ns + 2 * PERIOD_NS - 1
    assert others_ns == [first_ns + 2 * PERIOD_NS, first_ns + 3 * PERIOD_NS]


def test_a_frame_a_whole_period_late_shifts_all_that_follow() -> None:
    begins = begins_ns([0, PERIOD_NS, 0])
    assert [begin - begins[0] for begin in begins] == [0, 2 * PERIOD_NS, 3 * PERIOD_NS]
