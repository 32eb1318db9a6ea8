"""The priority of observers: after the run's processes, but not so low that these wait for them."""

import os
import threading

import pytest

from protocol.observer import NICE, lower_priority


def in_a_thread(work) -> list:
    """Returns what a function gives in a thread of its own, the only one whose priority it sets."""
    results: list = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join()
    return results


def own_priority() -> tuple[int, int]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


def test_it_is_low_but_no_idle_work_which_hardly_runs_on_a_busy_machine():
    before = own_priority()
    [found] = in_a_thread(lambda: (lower_priority(), own_priority())[1])
    assert found == (os.SCHED_OTHER, max(before[1], NICE))
    assert own_priority() == before


def test_one_that_is_lower_already_is_not_raised():
    def lowered_twice() -> tuple[int, int]:
        os.setpriority(os.PRIO_PROCESS, 0, 19)
        lower_priority()
        return own_priority()

    assert in_a_thread(lowered_twice) == [(os.SCHED_OTHER, 19)]


@pytest.mark.parametrize("policy", [os.SCHED_FIFO, os.SCHED_RR])
def test_real_time_priority_of_the_run_is_given_up(policy):
    def lowered() -> tuple[int, int] | None:
        try:
            os.sched_setscheduler(0, policy, os.sched_param(1))
        except PermissionError:
            return None
        lower_priority()
        return own_priority()

    [found] = in_a_thread(lowered)
    if found is None:
        pytest.skip("needs the right to set real-time priority")
    assert found[0] == os.SCHED_OTHER
    assert found[1] >= NICE
