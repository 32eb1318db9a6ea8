"""Which of the edge's plans an agent follows."""

from __future__ import annotations

import numpy as np

from protocol.messages import Plan
from sensing.limits import MAX_AGE_FRAMES
from sensing.uplink import PlanHistory


def plan(frame: int) -> Plan:
    return Plan(
        frame=frame,
        agent="a",
        mbps=0.0,
        enough=frame - 2,
        agents=[],
        sites=np.zeros((0, 2)),
        weights_m2=np.zeros((0, 3)),
    )


def received(*frames: int, arrival_sim_ns: int = 0) -> PlanHistory:
    plans = PlanHistory()
    for frame in frames:
        plans.receive(plan(frame), frame=max(frame - 1, 0), arrival_sim_ns=arrival_sim_ns)
    return plans


def followed(plans: PlanHistory, frame: int, sim_time_ns: int = 0) -> int | None:
    found = plans.of(frame, sim_time_ns)
    return None if found is None else found.frame


def test_a_plan_holds_from_its_frame_on_until_a_newer_one_does() -> None:
    plans = received(3, 4, 6)
    assert [followed(plans, frame) for frame in (2, 3, 4, 5, 6, 7)] == [None, 3, 4, 4, 6, 6]
    assert plans.newest is not None
    assert plans.newest.frame == 6


def test_an_old_plan_is_of_a_scene_that_has_passed() -> None:
    plans = received(3)
    assert followed(plans, 3 + MAX_AGE_FRAMES) == 3
    assert followed(plans, 4 + MAX_AGE_FRAMES) is None


def test_a_plan_that_has_not_arrived_in_simulated_time_is_not_followed() -> None:
    plans = received(3, arrival_sim_ns=100)
    assert followed(plans, 3, sim_time_ns=99) is None
    assert followed(plans, 3, sim_time_ns=100) == 3


def test_what_is_older_or_absurd_is_left_and_does_not_bar_the_way() -> None:
    plans = received(5)
    assert not plans.receive(plan(4), frame=5, arrival_sim_ns=0)
    assert not plans.receive(plan(10**6), frame=5, arrival_sim_ns=0)
    assert plans.receive(plan(6), frame=5, arrival_sim_ns=0)
