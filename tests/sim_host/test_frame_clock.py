"""The beat of realtime frames."""

from sim_host.role import FrameClock


def test_frames_keep_time_whatever_they_take() -> None:
    clock = FrameClock(100)
    assert clock.wait_ns(1000) == 0
    clock.begin_frame(1000)
    assert clock.wait_ns(1030) == 70
    clock.begin_frame(1105)  # 5 late: the next is due at 1200 all the same
    assert clock.wait_ns(1105) == 95
    assert clock.late == 0


def test_a_world_that_falls_behind_slips_and_counts() -> None:
    clock = FrameClock(100)
    clock.begin_frame(1000)
    clock.begin_frame(1250)
    assert clock.late == 1
    assert clock.wait_ns(1250) == 100
