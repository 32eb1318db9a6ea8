"""Who looks on takes no more than its share of the machine."""

from hypothesis import given
from hypothesis import strategies as st

from protocol.courtesy import Budget


@given(st.lists(st.tuples(st.integers(0, 10**9), st.integers(1, 10**8))), st.floats(0.01, 1))
def test_a_work_takes_no_more_than_its_share(steps, share):
    budget, now_ns, spent_ns = Budget(share, 0), 0, 0
    for passed_ns, cost_ns in steps:
        now_ns += passed_ns
        if budget.has_some(now_ns):
            budget.spend(cost_ns)
            spent_ns += cost_ns
    assert spent_ns <= now_ns * share + 10**8


@given(st.integers(1, 10**9), st.floats(0.01, 1), st.integers(0, 10**9))
def test_who_waits_as_long_as_told_has_time_then_and_not_before(cost_ns, share, now_ns):
    budget = Budget(share, 0)
    budget.spend(cost_ns)
    wait_ns = round(budget.wait_s(now_ns) * 1e9)
    if wait_ns > 2:
        assert not budget.has_some(now_ns + wait_ns // 2)
    assert budget.has_some(now_ns + wait_ns + 10**3)
    assert budget.wait_s(now_ns + wait_ns + 10**3) == 0


def test_who_has_no_share_waits_for_ever():
    assert Budget(0.0, 0).wait_s(1) == float("inf")
