"""The signal role on in-process buses."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import messages as m
from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox, Presence
from protocol.process import Context
from protocol.topics import BusName
from signal_controller.role import MAX_KEPT, SignalRole
from tests.roads import MAIN_AND_SIDE


class Rig:
    """A signal role, and the publishers and subscribers around it."""

    def __init__(
        self, mode: str = "lockstep", policy: str = "max_pressure", **keys: object
    ) -> None:
        scenario = {"mode": mode, "regions": {"r0": ["j"]}, "signal": {"policy": policy, **keys}}
        scenario["edge"] = {"upstream_m": 200}
        scenario["cabinet"] = {"min_green_s": 5, "yellow_s": 4, "all_red_s": 1, "stale_after_s": 3}
        setup = m.Setup(
            scenario=scenario,
            road_map=MAIN_AND_SIDE,
            vehicle_types=[],
            meshes=[],
            mesh_vertices=np.zeros((0, 3), np.float32),
            mesh_triangles=np.zeros((0, 3), np.int32),
        )
        world, v2x = InProcessRouter(BusName.WORLD), InProcessRouter()
        self.inbox, self.seen = Inbox(), Inbox()
        self.others = v2x.bus(self.seen)
        self.others.subscribe("request")
        self.others.subscribe("advice")
        self.others.watch()
        world.bus(self.seen).subscribe("metrics")
        bus = v2x.bus(self.inbox)
        own_world = world.bus(self.inbox)
        context = Context(
            "signal-r0", setup, Path(), own_world, bus, self.inbox, threading.Event(), lambda: bus
        )
        self.role = SignalRole.build(context)
        assert self.seen.get() == Presence("signal", "signal-r0", alive=True)

    def publish_counts(
        self, frame: int, main: int, side: int, age_ns: int = 0, seen: float | None = None
    ) -> None:
        counts = m.LaneCounts(
            frame=frame,
            sim_time_ns=frame * 10**8 - age_ns,
            tls="j",
            agents=[],
            complete=True,
            upstream={"main": main, "side": side},
            downstream={"out": 0},
            coverage_upstream={} if seen is None else {"main": seen, "side": seen},
            coverage_from_bar={} if seen is None else {"main": seen, "side": seen},
        )
        self.others.publish("lanes", counts, region="r0", tls="j")

    def publish_detections(
        self, frame: int, *distances_m: float, age_ns: int = 0, sources: list[str] | None = None
    ) -> None:
        count = len(distances_m)
        detections = m.Detections(
            frame=frame,
            sim_time_ns=frame * 10**8 - age_ns,
            agents=[],
            boxes=np.tile(np.array([0, 0, 1, 4.5, 1.8, 1.5, 0], np.float32), (count, 1)),
            scores=np.ones(count, np.float32),
            classes=np.zeros(count, np.uint8),
            lanes=["side"] * count,
            distances_m=np.array(distances_m, np.float32),
            sources=sources or ["lidar"] * count,
            track_ids=np.zeros(count, np.int64),
            **{
                name: np.zeros(count, np.float32)
                for name in ("speeds_mps", "coasted_s", "ages_s", "position_std_m", "speed_std_mps")
            },
        )
        self.others.publish("detections", detections, region="r0")

    def publish_state(self, frame: int, green: str, stage: str = "green") -> None:
        state = m.SignalState(
            frame=frame,
            sim_time_ns=frame * 10**8,
            tls="j",
            state=green,
            stage=stage,
            green=green,
            source="plan",
            earliest_change_ns=0,
        )
        self.others.publish("state", state, tls="j")

    def turn(self) -> list[m.Message]:
        while (item := self.inbox.get()) is not None:
            self.role.on(item)
        self.role.poll()
        published = []
        while (item := self.seen.get()) is not None:
            assert isinstance(item, Envelope)
            published.append(item.message)
        return published


def requests(published: list[m.Message]) -> list[tuple[int, int, str, str]]:
    return [
        (r.frame, r.sim_time_ns, r.state, r.policy)
        for r in published
        if isinstance(r, m.SignalRequest)
    ]


def test_each_frames_counts_get_one_request_and_metrics() -> None:
    rig = Rig()
    rig.publish_state(4, "Gr")
    rig.publish_counts(4, main=1, side=3)
    published = rig.turn()
    assert requests(published) == [(4, 4 * 10**8, "rG", "max_pressure")]
    (metrics,) = [message for message in published if isinstance(message, m.Metrics)]
    assert [span.stage for span in metrics.spans] == ["decide"]
    assert (metrics.process, metrics.frame, metrics.drops) == ("signal-r0", 4, {})
    assert rig.turn() == []


@pytest.mark.parametrize("state_first", [True, False])
def test_in_lockstep_counts_and_state_of_a_frame_meet_in_any_order(state_first: bool) -> None:
    rig = Rig()
    rig.publish_state(0, "Gr")
    rig.publish_counts(0, 1, 1)
    assert requests(rig.turn()) == [(0, 0, "Gr", "max_pressure")]
    if state_first:
        rig.publish_state(1, "rG")
        assert requests(rig.turn()) == []
        rig.publish_counts(1, 1, 1)
    else:
        rig.publish_counts(1, 1, 1)
        assert requests(rig.turn()) == []
        rig.publish_state(1, "rG")
    assert requests(rig.turn()) == [(1, 10**8, "rG", "max_pressure")]


def test_in_realtime_nothing_is_waited_for_and_the_newest_counts_matter() -> None:
    rig = Rig(mode="realtime")
    rig.publish_counts(0, 5, 1)
    rig.publish_counts(1, 1, 5)
    assert requests(rig.turn()) == [(1, 10**8, "rG", "max_pressure")]
    rig.publish_counts(0, 5, 1)
    assert rig.turn() == []
    rig.publish_counts(2, 1, 5)
    (metrics,) = [message for message in rig.turn() if isinstance(message, m.Metrics)]
    assert metrics.drops == {"late": 1}


def test_the_fixed_policy_follows_the_plan() -> None:
    rig = Rig(policy="fixed")
    for frame in (299, 301):
        rig.publish_state(frame, "Gr")
        rig.publish_counts(frame, 0, 9)
        expected = "Gr" if frame == 299 else "rG"
        assert requests(rig.turn()) == [(frame, frame * 10**8, expected, "fixed")]


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize("absurd", [1 << 35, 70, 40])
def test_one_absurd_frame_number_stops_no_decisions(mode: str, absurd: int) -> None:
    rig = Rig(mode=mode)
    rig.publish_state(0, "Gr")
    rig.publish_counts(absurd, 9, 0)
    rig.publish_state(absurd + 1, "Gr")
    for frame in range(12):
        rig.publish_state(frame, "Gr")
        rig.publish_counts(frame, 1, 3)
        (request,) = requests(rig.turn())
        assert request[0] == frame


FRAMES = st.integers(0, 60) | st.integers(0, 1 << 35)


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@settings(max_examples=30, deadline=None)
@given(
    sent=st.lists(st.tuples(st.sampled_from(["counts", "state", "vehicles"]), FRAMES), min_size=30)
)
def test_whatever_frames_are_sent_a_few_wait(mode: str, sent: list[tuple[str, int]]) -> None:
    rig = Rig(mode=mode, policy="predictive")
    publish = {
        "counts": lambda frame: rig.publish_counts(frame, 1, 3),
        "state": lambda frame: rig.publish_state(frame, "Gr"),
        "vehicles": lambda frame: rig.publish_detections(frame, 5.0),
    }
    for topic, frame in sent:
        publish[topic](frame)
        rig.turn()
        for control in rig.role._deciders.values():
            for kept in (control._counts, control._shown, control._vehicles):
                assert len(kept) <= MAX_KEPT


def test_a_controller_that_starts_in_mid_run_finds_in_by_the_signals_states() -> None:
    rig = Rig()
    rig.publish_counts(0, 9, 0)
    for frame in range(500, 504):
        rig.publish_state(frame, "Gr")
    rig.publish_counts(503, 1, 3)
    assert [request[0] for request in requests(rig.turn())] == [503]


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize(
    ("age_ns", "reason"), [(10**9 + 1, "stale_counts"), (-(10**9) - 1, "future_counts")]
)
def test_counts_that_are_not_of_the_present_are_never_acted_on(
    mode: str, age_ns: int, reason: str
) -> None:
    rig = Rig(mode=mode)
    rig.publish_state(20, "Gr")
    rig.publish_counts(20, main=1, side=9, age_ns=age_ns)
    (metrics,) = rig.turn()
    assert isinstance(metrics, m.Metrics)
    assert (metrics.spans, metrics.drops) == ([], {reason: 1})
    rig.publish_counts(20, main=1, side=9)
    assert requests(rig.turn()) == [(20, 2 * 10**9, "rG", "max_pressure")]


def test_counts_that_the_signals_states_have_left_behind_are_stale() -> None:
    rig = Rig(mode="realtime", stale_after_s=0.5)
    for frame in range(8):
        rig.publish_state(frame, "Gr")
    rig.publish_counts(1, 1, 9)
    rig.publish_counts(2, 9, 1)
    assert requests(rig.turn()) == [(2, 2 * 10**8, "Gr", "max_pressure")]
    rig = Rig(mode="realtime", stale_after_s=0.5)
    for frame in range(8):
        rig.publish_state(frame, "Gr")
    rig.publish_counts(1, 1, 9)
    (metrics,) = [message for message in rig.turn() if isinstance(message, m.Metrics)]
    assert metrics.drops == {"stale_counts": 1}


def decided(rig: Rig) -> tuple[str, str, list[str]]:
    (request,) = [message for message in rig.turn() if isinstance(message, m.SignalRequest)]
    return request.state, request.policy, request.unknown


def test_a_controller_without_coverage_estimates_then_asks_for_the_plan_and_returns() -> None:
    rig = Rig(estimator_timeout_s=1.0, estimator_inflow_vph=3600)
    decisions = []
    for frame in range(1, 40):
        is_dark = 5 <= frame < 30
        rig.publish_state(frame, "Gr")
        rig.publish_counts(frame, 3, 0, seen=not is_dark)
        decisions.append(decided(rig))
    assert decisions[:4] == [("Gr", "max_pressure", [])] * 4
    assert decisions[4:13] == [("Gr", "max_pressure", ["main", "side"])] * 9
    assert decisions[13:29] == [("Gr", "plan", ["main", "side"])] * 16
    assert decisions[29:] == [("Gr", "max_pressure", [])] * 10


def test_what_is_not_seen_is_empty_where_that_is_asked_for() -> None:
    rig = Rig(unseen="empty", estimator_timeout_s=1.0)
    for frame in range(1, 40):
        rig.publish_state(frame, "Gr")
        rig.publish_counts(frame, 0, 1, seen=0.0)
        assert decided(rig) == ("rG", "max_pressure", [])


@pytest.mark.parametrize("detections_first", [True, False])
def test_a_policy_that_needs_vehicles_waits_for_those_of_the_frame(detections_first: bool) -> None:
    rig = Rig(policy="predictive")
    for frame in range(60, 63):
        rig.publish_state(frame, "Gr")
        if detections_first:
            rig.publish_detections(frame, 4.0, 11.0)
            assert requests(rig.turn()) == []
            rig.publish_counts(frame, main=0, side=2)
        else:
            rig.publish_counts(frame, main=0, side=2)
            assert requests(rig.turn()) == []
            rig.publish_detections(frame, 4.0, 11.0)
        assert requests(rig.turn()) == [(frame, frame * 10**8, "rG", "predictive")]


def test_vehicles_of_another_time_or_far_frames_are_not_used() -> None:
    rig = Rig(policy="predictive")
    rig.publish_state(60, "Gr")
    rig.publish_counts(60, main=0, side=2)
    rig.publish_detections(60, 4.0, age_ns=5)
    rig.publish_detections(1 << 35, 4.0)
    assert requests(rig.turn()) == []
    rig.publish_detections(60, 4.0)
    assert [request[0] for request in requests(rig.turn())] == [60]
    rig.publish_detections(60, 4.0)
    rig.publish_state(61, "Gr")
    rig.publish_counts(61, main=0, side=2)
    rig.publish_detections(61, 4.0)
    (metrics,) = [message for message in rig.turn() if isinstance(message, m.Metrics)]
    assert metrics.drops == {"far_frame": 1, "late": 1}


def test_policies_of_counts_alone_get_no_vehicles() -> None:
    rig = Rig()
    rig.publish_state(4, "Gr")
    rig.publish_detections(4, 4.0)
    rig.publish_counts(4, main=1, side=3)
    assert requests(rig.turn()) == [(4, 4 * 10**8, "rG", "max_pressure")]


@pytest.mark.parametrize("is_on", [True, False])
def test_those_who_report_themselves_are_advised_where_that_is_on(
    is_on: bool,
) -> None:
    rig = Rig(policy="predictive", speed_advice=is_on)
    rig.publish_state(60, "Gr")
    rig.publish_counts(60, main=0, side=4)
    rig.publish_detections(60, 4.0, 11.0, 90.0, 110.0, sources=["a", "lidar", "lidar", "b"])
    published = [one for one in rig.turn() if isinstance(one, m.SpeedAdvice | m.SignalRequest)]
    assert requests(published) == [(60, 6 * 10**9, "rG", "predictive")]
    advised = [one for one in published if isinstance(one, m.SpeedAdvice)]
    assert [(one.frame, one.sim_time_ns, one.tls, one.agent) for one in advised] == (
        [(60, 6 * 10**9, "j", "b")] if is_on else []
    )
    assert isinstance(published[-1], m.SignalRequest)
    assert published[-1].advised == len(advised)
    assert all(5 <= one.speed_mps <= 14 for one in advised)


def test_whoever_is_gone_is_told_once_that_advice_has_ended() -> None:
    rig, decisions = Rig(policy="predictive", speed_advice=True), []
    for frame in range(60, 63):
        rig.publish_state(frame, "Gr")
        rig.publish_counts(frame, main=0, side=4)
        sources = ["lidar", "b" if frame == 60 else "lidar"]
        rig.publish_detections(frame, 4.0, 110.0, sources=sources)
        published = [one for one in rig.turn() if isinstance(one, m.SpeedAdvice)]
        decisions.append([(one.agent, one.speed_mps is None) for one in published])
    assert decisions == [[("b", False)], [("b", True)], []]
