"""The signal safety check finds each breach, and none where there is none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.roadmap import PlanPhase, Signal
from sim_host.config import CabinetConfig
from tests.signal_safety import violations

S = 1_000_000_000
CONFIG = CabinetConfig(min_green_s=5, yellow_s=4, all_red_s=1)
SIGNAL = Signal(
    tls="J",
    links=[],
    conflicts=[(0, 1), (0, 2), (1, 2)],
    plan=[PlanPhase(duration_s=20, state=state) for state in ("Ggr", "rrG")],
)
GOOD = (("rrr", 1), ("Ggr", 5), ("yyr", 4), ("rrr", 1), ("rrG", 5), ("rry", 4), ("rrr", 1))


def shown(*stages: tuple[str, float], step_s: float = 0.1) -> list[tuple[int, str]]:
    """Returns each step's state, sampled at the end of the step."""
    states = [state for state, lasts_s in stages for _ in range(round(lasts_s / step_s))]
    return [(round((n + 1) * step_s * S), state) for n, state in enumerate(states)]


def found(*stages: tuple[str, float]) -> list[str]:
    return violations(shown(*stages), SIGNAL, CONFIG, 0.1)


def test_a_signal_that_keeps_its_times_is_safe() -> None:
    assert found(*GOOD, *GOOD, ("Ggr", 9)) == []


@pytest.mark.parametrize(
    ("stage", "state", "lasts_s", "message"),
    [
        (1, "Ggr", 4.9, "link 0 was green for 4.9 s at most"),
        (2, "yyr", 3.9, "link 1 was yellow for 3.9 s at most"),
        (3, "rrr", 0.9, "link 2 turned green 0.9 s after link 0 was yellow, 1 s are needed"),
        (2, "rrr", 4.0, "link 0 went from green to red without yellow"),
        (2, "yrr", 4.0, "link 1 went from green to red without yellow"),
        (3, "yrG", 1.0, "link 2 turned green 0 s after link 0 was yellow"),
        (3, "rrG", 1.0, "link 2 turned green 0 s after link 1 was yellow"),
        (3, "Ggr", 1.0, "link 0 turned green 0 s after link 0 was yellow"),
        (4, "rgG", 5.0, "rgG: links 1 and 2 conflict and both have right of way"),
        (1, "GGr", 5.0, "GGr: links 0 and 1 conflict"),
        (1, "gGr", 5.0, "gGr: links 0 and 1 conflict"),
        (3, "ryr", 1.0, "link 2 turned green 0 s after link 1 was yellow"),
        (0, "rry", 1.0, "link 0 turned green 0 s after link 2 was yellow"),
        (4, "rrr", 5.0, "link 2 went from red to yellow without green"),
        (4, "rrrr", 1.0, "'rrrr' has not one character for each link"),
    ],
)
def test_each_breach_is_named(stage: int, state: str, lasts_s: float, message: str) -> None:
    stages = list(GOOD)
    stages[stage] = (state, lasts_s)
    assert any(message in one for one in found(*stages))


def test_who_had_right_of_way_is_stopped_before_it_yields() -> None:
    turn = Signal(
        tls="J",
        links=[],
        conflicts=[(0, 1)],
        plan=[PlanPhase(duration_s=20, state=state) for state in ("Gr", "gG")],
    )
    at_once = shown(("Gr", 9), ("gG", 9))
    assert violations(at_once, turn, CONFIG, 0.1) == [
        "signal J at 9.1 s: link 0 had right of way and has to yield without yellow"
    ]
    stopped = shown(("Gr", 9), ("yr", 4), ("rr", 1), ("gG", 9))
    assert violations(stopped, turn, CONFIG, 0.1) == []
    assert violations([at_once[0], at_once[-1]], turn, CONFIG, 0.1) == []


def test_a_breach_is_named_with_its_signal_and_time() -> None:
    assert found(("rrr", 1), ("GrG", 1)) == [
        "signal J at 1.1 s: GrG: links 0 and 2 conflict and both have right of way"
    ]


def test_time_that_runs_back_is_named() -> None:
    found = violations([(2 * S, "rrr"), (S, "Ggr")], SIGNAL, CONFIG, 0.1)
    assert found == ["signal J at 1 s: time does not increase from 2000000000 ns"]


@given(st.data())
def test_moments_that_nobody_told_of_are_not_held_against_a_signal(data: st.DataObject) -> None:
    moments = shown(*GOOD, *GOOD, *GOOD)
    kept = data.draw(st.lists(st.booleans(), min_size=len(moments), max_size=len(moments)))
    some = [one for one, keep in zip(moments, kept, strict=True) if keep]
    assert violations(some, SIGNAL, CONFIG, 0.1) == []


def test_a_second_between_moments_still_shows_a_yellow_of_half_its_time() -> None:
    moments = shown(*GOOD[:2], ("yyr", 2), *GOOD[3:])
    found = violations(moments[::10], SIGNAL, CONFIG, 0.1)
    assert any("yellow" in one for one in found)
