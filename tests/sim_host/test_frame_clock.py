"""The beat of realtime frames."""

from sim_host.role import FrameClock


def test_frames_keep_time_whatever_they_take() -> None:
    beat = FrameClock(100)
    assert beat.wait_ns(1000) == 0
    beat.strike(1000)
    assert beat.wait_ns(1030) == 70
    beat.strike(1105)  # 5 late: the next is due at 1200 all the same
    assert beat.wait_ns(1105) == 95
    assert beat.late == 0


def test_a_world_that_falls_behind_slips_and_counts() -> None:
    beat = FrameClock(100)
    beat.strike(1000)
    beat.strike(1250)
    assert beat.late == 1
    assert beat.wait_ns(1250) == 100
