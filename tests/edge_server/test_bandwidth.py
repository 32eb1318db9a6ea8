"""The estimate against uplinks whose rate is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_server import planner as module
from edge_server.planner import LEAST_MBPS, MOST_MBPS, Bandwidth

PERIOD_NS = 100_000_000


class Link:
    """An uplink of a constant rate and delay that sends whatever it is given, in order."""

    def __init__(self, mbps: float, delay_ms: float = 8.0, ahead_ns: int = 0) -> None:
        self.mbps, self.delay_ns, self.ahead_ns = mbps, round(delay_ms * 1e6), ahead_ns
        self.free_ns = 0

    def send(self, to: Bandwidth, agent: str, frame: int, sizes: list[int]) -> None:
        sent_ns = frame * PERIOD_NS
        for size in sizes:
            self.free_ns = max(self.free_ns, sent_ns) + round(size * 8e3 / self.mbps)
            to.add(
                agent,
                frame,
                size,
                sent_ns=sent_ns + self.ahead_ns,
                received_ns=self.free_ns + self.delay_ns,
            )


@given(st.floats(1, 200), st.lists(st.integers(2_000, 60_000), min_size=1, max_size=4))
def test_the_estimate_finds_the_rate_of_a_busy_uplink(mbps: float, sizes: list[int]) -> None:
    bandwidth, link = Bandwidth(), Link(mbps)
    for frame in range(12):
        link.send(bandwidth, "a", frame, [60, *sizes])
    # The small message has the rate's share in the delay that it measures.
    assert bandwidth.mbps("a") == pytest.approx(mbps, rel=0.06)


def test_without_small_messages_the_delay_counts_as_sending() -> None:
    bandwidth, link = Bandwidth(), Link(5.0)
    for frame in range(12):
        link.send(bandwidth, "a", frame, [50_000])
    assert bandwidth.mbps("a") == pytest.approx(5.0 * 80 / 88, rel=0.01)


def test_each_agent_has_a_history_of_its_own() -> None:
    bandwidth, links = Bandwidth(), {"a": Link(2.0), "b": Link(40.0)}
    for frame in range(12):
        for agent, link in links.items():
            link.send(bandwidth, agent, frame, [60, 9_000, 9_000])
    assert bandwidth.mbps("a") == pytest.approx(2.0, rel=0.06)
    assert bandwidth.mbps("b") == pytest.approx(40.0, rel=0.06)
    assert bandwidth.mbps("c") is None


def test_the_estimate_follows_an_uplink_that_becomes_slow_within_a_second() -> None:
    bandwidth, link = Bandwidth(), Link(20.0)
    for frame in range(20):
        link.mbps = 20.0 if frame < 10 else 4.0
        link.send(bandwidth, "a", frame, [60, 20_000])
    assert bandwidth.mbps("a") == pytest.approx(4.0, rel=0.25)


def test_clocks_that_differ_leave_the_rate_of_chunks_that_follow_each_other() -> None:
    for ahead_ns in (10**15, -(10**15)):
        bandwidth, link = Bandwidth(), Link(8.0, ahead_ns=ahead_ns)
        for frame in range(12):
            link.send(bandwidth, "a", frame, [60, 20_000, 20_000])
        assert bandwidth.mbps("a") == pytest.approx(8.0, rel=0.01)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 10**6),
            st.integers(0, 10**8),
            st.integers(-(2**62), 2**62),
            st.integers(-(2**62), 2**62),
        ),
        max_size=20,
    )
)
def test_whatever_is_claimed_the_estimate_stays_within_its_bounds(
    claims: list[tuple[int, int, int, int]],
) -> None:
    bandwidth = Bandwidth()
    for frame, size, sent_ns, received_ns in claims:
        bandwidth.add("a", frame, size, sent_ns=sent_ns, received_ns=received_ns)
    mbps = bandwidth.mbps("a")
    assert mbps is None or LEAST_MBPS <= mbps <= MOST_MBPS


def test_agents_are_forgotten_and_their_number_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_UPLINKS", 2)
    bandwidth = Bandwidth()
    for agent in "abc":
        Link(5.0).send(bandwidth, agent, 0, [9_000])
    assert [bandwidth.mbps(agent) is None for agent in "abc"] == [False, False, True]
    bandwidth.forget(1_000)
    Link(5.0).send(bandwidth, "c", 1_000, [9_000])
    assert [bandwidth.mbps(agent) is None for agent in "abc"] == [True, True, False]
    assert np.isfinite(bandwidth.mbps("c") or 0)
