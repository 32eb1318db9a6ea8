import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sensing.link_channel import InterruptedSteps, StepFunction

TIMES = st.integers(-10_000, 10_000)


@st.composite
def steps(draw: st.DrawFn) -> StepFunction:
    starts = sorted({0, *draw(st.lists(st.integers(1, 199), max_size=6))})
    values = draw(st.lists(st.integers(0, 50), min_size=len(starts), max_size=len(starts)))
    if not any(values):
        values[0] = 1
    return StepFunction(starts, values, 200)


@settings(deadline=None)
@given(steps(), TIMES, st.integers(0, 700))
def test_the_integral_is_the_sum_over_every_nanosecond(trace, start, length):
    expected = sum(trace.at(t) for t in range(start, start + length))
    assert trace.integral(start, start + length) == expected


@settings(deadline=None)
@given(steps(), TIMES, st.integers(0, 30_000))
def test_an_amount_is_reached_at_the_first_moment_that_holds_it(trace, start, amount):
    end = trace.reach(start, amount)
    assert end >= start
    assert trace.integral(start, end) >= amount
    assert amount == 0 or trace.integral(start, end - 1) < amount


@settings(deadline=None)
@given(steps(), TIMES, st.integers(0, 700))
def test_changes_are_the_starts_of_steps(trace, after, length):
    expected = [t for t in range(after + 1, after + length + 1) if t % 200 in trace.starts_ns]
    assert list(trace.changes(after, after + length)) == expected


def test_what_is_always_zero_is_never_reached():
    with pytest.raises(ValueError, match="nothing ever passes"):
        StepFunction([0], [0], 10).reach(0, 1)


@pytest.mark.parametrize(
    ("starts", "values"), [([1], [1]), ([0, 5, 5], [1, 1, 1]), ([0, 10], [1, 1]), ([0], [-1])]
)
def test_steps_that_cannot_be_are_refused(starts, values):
    with pytest.raises(ValueError, match="steps"):
        StepFunction(starts, values, 10)


@st.composite
def interrupted(draw: st.DrawFn) -> tuple[InterruptedSteps, StepFunction, list[tuple[int, int]]]:
    base = draw(steps())
    edges = sorted(draw(st.sets(st.integers(1, 599), max_size=8)))
    gone = list(zip(edges[::2], edges[1::2], strict=False))
    return InterruptedSteps(base, gone, 3), base, gone


@settings(deadline=None)
@given(interrupted(), TIMES, st.integers(0, 700))
def test_within_a_span_nothing_passes_and_outside_all_does(made, start, length):
    trace, base, gone = made
    for t in range(start, start + length):
        lost = any(a <= t % 600 < b for a, b in gone)
        assert trace.at(t) == (0 if lost else base.at(t))
    expected = sum(trace.at(t) for t in range(start, start + length))
    assert trace.integral(start, start + length) == expected


@settings(deadline=None)
@given(interrupted(), TIMES, st.integers(1, 30_000))
def test_an_amount_is_reached_past_the_spans_at_its_first_moment(made, start, amount):
    trace, _, _ = made
    assume(trace.integral(0, 600) > 0)
    end = trace.reach(start, amount)
    assert trace.integral(start, end) >= amount > trace.integral(start, end - 1)


def test_spans_that_overlap_or_leave_the_period_are_refused():
    for gone in ([(0, 5), (4, 6)], [(5, 11)]):
        with pytest.raises(ValueError, match="spans"):
            InterruptedSteps(StepFunction([0], [1], 10), gone, 1)
