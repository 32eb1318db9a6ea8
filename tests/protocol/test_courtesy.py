"""Who looks on takes no more than its share of the machine."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.courtesy import LEFT_IDLE, SPARE_EVERY_NS, SPARE_TAKEN, Budget, Spare, core_quota


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


def account(path, *cores: tuple[int, int]) -> None:
    """Writes how long each core was busy and idle, as the kernel does."""
    lines = [f"cpu{n} {busy} 0 0 {idle} 0 0 0 0 0 0" for n, (busy, idle) in enumerate(cores)]
    total = [sum(column) for column in zip(*cores, strict=True)]
    path.write_text("\n".join([f"cpu  {total[0]} 0 0 {total[1]} 0 0 0 0 0 0", *lines, "ctxt 5"]))


@given(busy=st.integers(0, 1000), idle=st.integers(0, 1000))
def test_what_is_spare_is_a_part_of_what_is_idle_beyond_what_is_left_free(
    tmp_path_factory, busy, idle
):
    stat = tmp_path_factory.getbasetemp() / "stat"
    spare = Spare({0, 2}, stat)
    account(stat, (50, 50), (0, 0), (7, 0))
    assert spare(SPARE_EVERY_NS) == 0
    account(stat, (50 + busy, 50 + idle), (9999, 0), (7 + busy, idle))
    found = spare(2 * SPARE_EVERY_NS)
    free = idle / (busy + idle) if busy + idle else 0.0
    assert found == pytest.approx(2 * SPARE_TAKEN * max(0.0, free - LEFT_IDLE))
    account(stat, (0, 0), (0, 0), (0, 0))
    assert spare(2 * SPARE_EVERY_NS + 1) == found  # not read again so soon


def test_where_the_kernel_tells_nothing_there_is_nothing_to_spare(tmp_path):
    spare = Spare({0}, tmp_path / "none")
    assert [spare(n * SPARE_EVERY_NS) for n in range(4)] == [0] * 4


def test_what_is_spare_comes_on_top():
    budget = Budget(0.0, 0, lambda _: 0.5)
    budget.spend(10**8)
    assert budget.wait_s(0) == 0.2
    assert not budget.has_some(10**8)
    assert budget.has_some(3 * 10**8)


@pytest.mark.parametrize(
    ("text", "cores"), [("150000 100000", 1.5), ("max 100000", None), ("", None)]
)
def test_a_container_may_have_fewer_cores_than_the_machine(tmp_path, text, cores):
    (tmp_path / "cpu.max").write_text(text)
    assert core_quota(tmp_path) == cores
    assert core_quota(tmp_path / "none") is None
