"""A policy by its name: built in or a plug-in's, whose decisions are checked."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.messages import LaneCounts, SignalRequest, SignalState
from protocol.roadmap import Link, PlanPhase, Signal
from signal_controller.config import SignalConfig, check_policy
from signal_controller.observation import Observation, SignalSite
from signal_controller.policies import Decision, fixed, policy_of, pressure
from signal_controller.queue_estimator import MIN_COVERAGE, extrapolated
from tests.example_plugins import pretend
from tests.roads import lane, one_junction

MAIN, SIDE = "Gr", "rg"
SIGNAL = Signal(
    tls="j",
    links=[
        Link(index=0, from_lane="main", to_lane="out"),
        Link(index=1, from_lane="side", to_lane="out"),
    ],
    conflicts=[(0, 1)],
    plan=[
        PlanPhase(duration_s=30, state=MAIN),
        PlanPhase(duration_s=4, state="yr"),
        PlanPhase(duration_s=20, state=SIDE),
    ],
)
ROADS = one_junction(
    "roads",
    [
        lane("main", [(-100, 0, 0), (0, 0, 0)], "out"),
        lane("side", [(0, -100, 0), (0, 0, 0)], "out"),
        lane("out", [(0, 0, 0), (100, 0, 0)]),
    ],
    SIGNAL,
)
SITE = SignalSite(SIGNAL, ROADS, 200.0)
PLUGIN = """
from signal_controller.policies import Decision

class Echo:
    def __init__(self, config, site):
        self.made_with = config.plugin.get("mark"), site.signal.tls, site.upstream_m
    def decide(self, seen):
        frames = [float(seen.counts.frame), float(seen.shown.frame)]
        return Decision("Gr", frames, repr(self.made_with))

class Wrong:
    def __init__(self, config, site):
        self.answer = config.plugin["answer"]
    def decide(self, seen):
        if self.answer == "back in time":
            return Decision("Gr", [], "wrong", wait_s=-1)
        return Decision(self.answer, [], "wrong") if self.answer else 7
"""


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = {"echo": "cpnet_test_policies:Echo", "wrong": "cpnet_test_policies:Wrong"}
    points["lost"] = "cpnet_test_lost:Lost"
    pretend(
        tmp_path / "p",
        "more-policies",
        {"cpnet.signal_policies": points},
        cpnet_test_policies=PLUGIN,
    )
    monkeypatch.syspath_prepend(tmp_path / "p")


def counts(frame: int = 3, second: float = 0, **fields: dict[str, float]) -> LaneCounts:
    plain = {"upstream": {"main": 5, "side": 2}, "downstream": {}} | fields
    return LaneCounts(
        frame=frame, sim_time_ns=round(second * 1e9), tls="j", agents=[], complete=True, **plain
    )


def shown(frame: int, green: str = MAIN) -> SignalState:
    return SignalState(
        frame=frame,
        sim_time_ns=0,
        tls="j",
        state=green,
        stage="green",
        green=green,
        source="test",
        earliest_change_ns=0,
    )


def test_a_plug_in_is_made_for_the_signal_and_gets_each_frames_counts_and_state(plugins) -> None:
    policy = policy_of(SignalConfig(policy="echo", plugin={"mark": 9}), SITE)
    decision = policy.decide(Observation(counts(frame=3), shown(frame=4)))
    assert decision == Decision("Gr", [3.0, 4.0], "(9, 'j', 200.0)")


def test_the_request_of_a_decision_begins_when_the_decision_says() -> None:
    decision = Decision("Gr", [1.5], "mine", ("side",), wait_s=0.25)
    request = decision.request("j", 3, 2 * 10**9, advised=2, delay_sim_ns=7)
    assert request == SignalRequest(
        frame=3,
        sim_time_ns=2 * 10**9,
        tls="j",
        state="Gr",
        policy="mine",
        pressures=[1.5],
        unknown=["side"],
        advised=2,
        not_before_ns=2_250_000_000,
        delay_sim_ns=7,
    )


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (
            "",
            r"^the signal policy wrong of more-policies 1\.0 decided a int, must decide a Deci",
        ),
        ("back in time", r"waits -1 s, must be 0 to 3 \(cabinet\.stale_after_s\)$"),
        ("GrG", r"decided 'GrG', must be a G, g or r for each of 2 links$"),
        ("G", r"decided 'G', must be a G, g or r for each of 2 links$"),
        ("Gy", r"decided 'Gy', must be a G, g or r for each of 2 links$"),
        ("GX", r"decided 'GX', must be a G, g or r for each of 2 links$"),
    ],
)
def test_a_decision_that_is_none_for_this_signal_is_refused(plugins, answer, why) -> None:
    policy = policy_of(SignalConfig(policy="wrong", plugin={"answer": answer}), SITE)
    with pytest.raises(ConfigError, match=why):
        policy.decide(Observation(counts(), shown(1)))


@pytest.mark.parametrize("answer", ["gr", "rG", "rr"])
def test_any_green_for_each_link_is_a_decision(plugins, answer) -> None:
    policy = policy_of(SignalConfig(policy="wrong", plugin={"answer": answer}), SITE)
    assert policy.decide(Observation(counts(), shown(1))).state == answer


def test_a_plug_in_that_cannot_be_imported_is_found_before_the_start(plugins) -> None:
    check_policy(SignalConfig(policy="max_pressure"))
    check_policy(SignalConfig(policy="echo"))
    with pytest.raises(ConfigError, match="lost of more-policies"):
        check_policy(SignalConfig(policy="lost"))


@pytest.mark.parametrize(("second", "green"), [(29.999_999_999, MAIN), (30, SIDE), (53.9, SIDE)])
def test_the_fixed_plan_follows_the_clock_to_the_nanosecond(second, green) -> None:
    policy = policy_of(SignalConfig(policy="fixed"), SITE)
    assert policy.decide(Observation(counts(second=second), None)) == Decision(green, [], "fixed")
    assert fixed(SIGNAL, round(second * 1e9)).state == green


def test_a_green_is_held_before_pressures_may_end_it() -> None:
    policy = policy_of(SignalConfig(policy="max_pressure", hold_s=10, unseen="empty"), SITE)
    full = {"upstream": {"main": 1, "side": 9}, "coverage_upstream": {"main": 1.0, "side": 1.0}}

    def decided(second: float, green: str) -> str:
        return policy.decide(Observation(counts(second=second, **full), shown(1, green))).state

    assert [decided(second, MAIN) for second in (3, 4, 12.9)] == [MAIN] * 3
    assert decided(13, MAIN) == SIDE
    assert decided(20, SIDE) == SIDE
    assert SignalConfig().hold_s == 0


def test_a_permissive_green_opens_its_lane_too() -> None:
    assert pressure(SIGNAL, SIDE, {"main": 5, "side": 2}, {"out": 1}) == 1.0


def test_max_pressure_weighs_queues_if_asked_to() -> None:
    config = SignalConfig(policy="max_pressure", weight="queued")
    queued = {"stationary_upstream": {"main": 0, "side": 2}, "stationary_downstream": {"out": 1}}
    decision = policy_of(config, SITE).decide(Observation(counts(**queued), shown(1)))
    assert (decision.state, decision.pressures) == (SIDE, [-1.0, 1.0])


@pytest.mark.parametrize(("unseen", "main"), [("alike", 10.0), ("empty", 5.0)])
def test_max_pressure_extrapolates_covered_lanes_if_asked_to(unseen, main) -> None:
    policy = policy_of(SignalConfig(policy="max_pressure", unseen=unseen), SITE)
    covered = {"coverage_upstream": {"main": 0.5, "side": 1.0}}
    assert policy.decide(Observation(counts(**covered), shown(1))).pressures == [main, 2.0]


def test_a_lane_is_extrapolated_from_exactly_the_least_coverage_on() -> None:
    just_less = MIN_COVERAGE * (1 - 1e-9)
    assert extrapolated({"a": 1}, {"a": MIN_COVERAGE}) == {"a": 1 / MIN_COVERAGE}
    assert extrapolated({"a": 1}, {"a": just_less}) == {"a": 1}
