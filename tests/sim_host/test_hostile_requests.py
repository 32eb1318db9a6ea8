"""The cabinet under hostile requests, checked by the shown states alone."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.inbox import Envelope
from protocol.messages import SignalRequest
from protocol.roadmap import PlanPhase, Signal
from sim_host.cabinet import PendingRequests, SignalCabinet
from sim_host.config import CabinetConfig
from tests.hostile import KINDS, Hostile, S
from tests.signal_safety import SignalMonitor
from tests.sim_host.signals import signals

STEP_S = 0.1
STEP_NS = S // 10
CONFIG = CabinetConfig()
CROSSING = Signal(  # straight on and left turns that yield, both ways
    tls="J",
    links=[],
    conflicts=[(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)],
    plan=[
        PlanPhase(duration_s=duration_s, state=state)
        for duration_s, state in [(20, "Ggrr"), (5, "rrrr"), (20, "rrGg"), (5, "rrrr"), (9, "rGrr")]
    ],
)


class Kerb:
    """A cabinet with its waiting list, as the world's host has them, and who watches it."""

    def __init__(
        self, signal: Signal, config: CabinetConfig, promised: CabinetConfig | None = None
    ) -> None:
        self.signal = signal
        self.cabinet = SignalCabinet(signal, config)
        self.pending = PendingRequests()
        self.monitor = SignalMonitor(signal, promised or config, STEP_S)
        self.now_ns = 0
        self.received = 0
        self.acted: Counter[str] = Counter()
        self.found: list[str] = []
        self.shown: Counter[str] = Counter()

    def note(self, request: SignalRequest) -> None:
        self.received += 1
        if self.cabinet.refuse(request, self.now_ns) is None:
            self.pending.add(Envelope("request", {}, request, 0, b""), request)
            self.act()

    def act(self) -> None:
        taken = self.pending.take(
            self.now_ns, lambda one: self.cabinet.request(one, self.now_ns) is None
        )
        if taken is not None:
            self.acted[taken.request.policy] += 1
            self.cabinet.advance(self.now_ns)

    def send_request(self, state: str) -> None:
        self.note(
            SignalRequest(
                frame=0, sim_time_ns=self.now_ns, tls=self.signal.tls, state=state, policy="true"
            )
        )

    def step(self) -> None:
        self.act()
        state = self.cabinet.advance(self.now_ns)
        self.now_ns += STEP_NS
        self.found += self.monitor.observe(self.now_ns, state)
        self.shown[state] += 1


def check_counted(kerb: Kerb) -> None:
    """Checks that each request acted, was refused for a reason, was overtaken or still waits."""
    ended = kerb.acted.total() + kerb.cabinet.refusals.total() + kerb.pending.overtaken
    kerb.pending.take(1 << 62, lambda _: True)  # counts all but one that are left
    waiting = kerb.pending.overtaken + kerb.pending.crowded_out
    assert ended <= kerb.received <= ended + waiting + 1


steps = st.lists(
    st.tuples(st.integers(1, 60), st.lists(st.sampled_from(("true", *KINDS)), max_size=6)),
    min_size=5,
    max_size=60,
)


@given(
    steps,
    signals(),
    st.integers(0, 1 << 30),
    st.sampled_from([0.0, 0.5, 5.0]),
    st.sampled_from([0.0, 1.0]),
)
@settings(max_examples=200, deadline=None)
def test_no_stream_of_hostile_requests_makes_it_unsafe(
    stream: list[tuple[int, list[str]]],
    signal: Signal,
    seed: int,
    min_green_s: float,
    all_red_s: float,
) -> None:
    config = CabinetConfig(min_green_s=min_green_s, all_red_s=all_red_s, yellow_s=2)
    kerb, rng = Kerb(signal, config), np.random.default_rng(seed)
    hostile = Hostile(signal, rng)
    for ticks, kinds in stream:
        for kind in kinds:
            if kind == "true":
                kerb.send_request(signal.greens[rng.integers(len(signal.greens))])
            else:
                kerb.note(hostile.make(kind, kerb.now_ns))
        for _ in range(ticks):
            kerb.step()
    assert kerb.found == []
    check_counted(kerb)


@pytest.mark.parametrize(
    ("key", "word"),
    [("min_green_s", "green for"), ("yellow_s", "yellow for"), ("all_red_s", "1 s")],
)
def test_a_cabinet_that_cuts_a_time_short_by_a_step_is_found(key: str, word: str) -> None:
    hasty = CONFIG.model_copy(update={key: getattr(CONFIG, key) - STEP_S})
    kerb = Kerb(CROSSING, hasty, promised=CONFIG)
    for number in range(600):
        kerb.send_request(CROSSING.greens[number // 3 % 3])
        kerb.step()
    assert any(word in one for one in kerb.found)


def test_without_fresh_requests_the_plan_runs_and_control_returns_by_itself() -> None:
    kerb = Kerb(CROSSING, CONFIG)
    hostile = Hostile(CROSSING, np.random.default_rng(1))
    sources = []
    for second in range(90):
        for _ in range(10):
            if second // 30 != 1:
                kerb.send_request("rGrr")
            for kind in ("stale", "future", "other_signal", "all_green", "replayed"):
                kerb.note(hostile.make(kind, kerb.now_ns))
            kerb.step()
        sources.append(kerb.cabinet.spat(0, kerb.now_ns).source)
    assert set(sources[10:30]) == {"true"}
    assert set(sources[34:60]) == {"plan"}
    assert set(sources[70:]) == {"true"}
    assert kerb.found == []


@pytest.mark.slow
@pytest.mark.parametrize(("hours", "per_step"), [(0.1, 100), (30, 0.1)])
def test_a_soak_of_hostile_requests_shows_nothing_unsafe(hours: float, per_step: float) -> None:
    """100 a step of 0.1 s are 1000 a second; the other soak is long instead."""
    rng = np.random.default_rng(7)
    kerb, hostile = Kerb(CROSSING, CONFIG), Hostile(CROSSING, rng)
    wanted = CROSSING.greens[0]
    for number in range(round(hours * 36_000)):
        if rng.random() < 0.01:
            wanted = CROSSING.greens[rng.integers(3)]
        if number % 10 == 0 and number // 3000 % 2:
            kerb.send_request(wanted)
        many = int(per_step) or int(rng.random() < per_step)
        for _ in range(many):
            kerb.note(hostile.any(kerb.now_ns))
        kerb.step()
    assert kerb.found == []
    assert {"Ggrr", "rrGg", "rGrr"} < kerb.shown.keys()
    assert kerb.acted["true"] > 0
    assert kerb.cabinet.refusals.keys() >= {
        "wrong_tls", "wrong_length", "bad_alphabet", "no_green", "from_the_future", "stale",
        "replayed", "conflict",
    }  # fmt: skip
    check_counted(kerb)
