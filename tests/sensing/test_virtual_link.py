"""The link in simulated time: a queue that keeps order, wastes nothing and is never too fast."""

import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.traffic import on_air_bytes
from sensing.link_channel import Channel, VirtualLink
from sensing.link_config import profile_named
from sensing.link_profile import BUILTIN, LinkProfile, Outages, RoundTrip, TraceRate, VaryingRate

MS = 1_000_000
SENDS = st.lists(st.tuples(st.integers(0, 300 * MS), st.integers(1, 200_000)), max_size=30)


def traffic(sends: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Turns gaps into times."""
    now, result = 0, []
    for gap, size in sends:
        now += gap
        result.append((now, size))
    return result


paths = st.sampled_from(
    [
        Channel.draw(profile_named(name) or LinkProfile(), 3, "cav")
        for name in ("5g-urban", "5g-weak", "lte-poor", "5mbit", "300kbit,80ms")
    ]
)


@settings(max_examples=50, deadline=None)
@given(paths, SENDS)
def test_messages_arrive_in_order_and_not_before_the_link_could_carry_them(path, sends):
    link = VirtualLink(path)
    arrivals = [link.send(now, size).arrival_ns for now, size in traffic(sends)]
    assert arrivals == sorted(arrivals)
    for (now, size), arrival in zip(traffic(sends), arrivals, strict=True):
        bits = path.rate_bps.integral(now, arrival) / 1e9
        assert bits >= 8 * on_air_bytes(size)


@settings(max_examples=50, deadline=None)
@given(paths, SENDS)
def test_no_time_is_wasted_while_something_is_queued(path, sends):
    link = VirtualLink(path)
    busy_since, bits = 0, 0
    for queued, (now, size) in enumerate(traffic(sends), 1):
        if link.backlog_ns(now) == 0:
            busy_since, bits = now, 0
        link.send(now, size)
        bits += 8 * on_air_bytes(size)
        free = now + link.backlog_ns(now)
        carried = path.rate_bps.integral(busy_since, free)
        rounding = queued * path.rate_bps.largest  # a message ends on a whole ns
        assert bits * 10**9 <= carried <= bits * 10**9 + rounding


def recalling(link: VirtualLink, time_ns: int) -> list[int]:
    return [transmission.first_bit_ns for transmission in link.recall(time_ns)]


def test_what_has_not_begun_to_leave_can_be_taken_back() -> None:
    link = VirtualLink(Channel.draw(profile_named("8mbit") or LinkProfile(), 1, "a"))
    for _ in range(4):
        link.send(0, 948, recallable=True)  # 1000 bytes on the link: 1 ms each
    assert recalling(link, 1 * MS + 1) == [3 * MS, 2 * MS]
    assert link.backlog_ns(0) == 2 * MS
    assert recalling(link, 0) == []  # what is left counts as sent
    assert link.send(0, 948).first_bit_ns == 2 * MS


def test_what_stands_before_a_message_that_stays_is_not_taken_back() -> None:
    link = VirtualLink(Channel.draw(profile_named("8mbit") or LinkProfile(), 1, "a"))
    link.send(0, 948, recallable=True)
    link.send(0, 948)
    link.send(0, 948, recallable=True)
    assert recalling(link, 0) == [2 * MS]


def test_a_fixed_rate_takes_bits_over_rate_and_half_a_round_trip():
    link = VirtualLink(Channel.draw(profile_named("5mbit,20ms") or LinkProfile(), 1, "a"))
    latency_ns = link.send(7 * MS, 62_500).arrival_ns - 7 * MS
    assert latency_ns == on_air_bytes(62_500) * 8 * 200 + 10 * MS
    assert link.backlog_ns(7 * MS) == latency_ns - 10 * MS


def test_without_connection_a_message_waits_for_it():
    trace = TraceRate(starts_us=[0, 100_000], rates_bps=[0, 8_000_000], period_us=200_000)
    link = VirtualLink(Channel.draw(LinkProfile(rate=trace), 1, "a"))
    assert link.send(30 * MS, 948).arrival_ns == 101 * MS  # 1000 bytes on the link, 1 ms
    assert link.send(101 * MS, 948).arrival_ns == 102 * MS
    half_done = VirtualLink(Channel.draw(LinkProfile(rate=trace), 1, "a"))
    assert half_done.send(199_500_000, 948).arrival_ns == 300_500_000


def test_the_round_trip_of_a_trace_is_its_own():
    trace = TraceRate(
        starts_us=[0, 1000], rates_bps=[8_000_000] * 2, rtt_us=[0, 50_000], period_us=2000
    )
    path = Channel.draw(LinkProfile(rate=trace, rtt=RoundTrip.steady(9)), 1, "a")
    assert [path.delay_ns(t) for t in (0, 1 * MS)] == [0, 25 * MS]


def test_a_packet_that_travels_long_holds_up_those_behind_it():
    trace = TraceRate(
        starts_us=[0, 10_000], rates_bps=[8_000_000] * 2, rtt_us=[200_000, 0], period_us=900_000
    )
    link = VirtualLink(Channel.draw(LinkProfile(rate=trace), 1, "a"))
    arrival_ns = link.send(
        5 * MS, 14 * 948
    ).arrival_ns  # leaves from 5 to 19 ms, the first half goes slowly
    assert arrival_ns == 110 * MS - 1
    assert link.send(200 * MS, 948).arrival_ns == 201 * MS


@pytest.mark.parametrize("name", BUILTIN)
def test_built_in_profiles_have_the_figures_they_name(name):
    profile = BUILTIN[name]
    assert profile.source
    assert isinstance(profile.rate, VaryingRate)
    means, rtts = [], []
    for agent in range(4):
        path = Channel.draw(profile, 5, f"cav-{agent}")
        span_ns = path.rate_bps.period_ns
        means.append(path.rate_bps.integral(0, span_ns) / span_ns / 1e6)
        rtts += path.rtt_ns.values
    assert sum(means) / len(means) == pytest.approx(profile.rate.mean_mbps, rel=0.1)
    rtts.sort()
    for share, expected in ((0.5, "median_ms"), (0.95, "p95_ms"), (0.99, "p99_ms")):
        found_ms = rtts[int(share * len(rtts))] / 1e6
        assert found_ms == pytest.approx(getattr(profile.rtt, expected), rel=0.1)


def test_a_path_depends_on_seed_and_agent_alone():
    def draw(seed: int, agent: str) -> tuple[list[int], list[int]]:
        path = Channel.draw(BUILTIN["5g-weak"], seed, agent)
        rates = [path.rate_bps.at(t) for t in range(0, path.rate_bps.period_ns, 100 * MS)]
        return rates, path.rtt_ns.values

    assert draw(1, "a") == draw(1, "a")
    assert draw(1, "a") != draw(1, "b")
    assert draw(1, "a") != draw(2, "a")


def test_outages_take_their_share_and_leave_the_rest_alone():
    quiet = LinkProfile(rate=VaryingRate(mean_mbps=8))
    lossy = quiet.model_copy(update={"outages": Outages(per_minute=6, mean_s=2)})
    path = Channel.draw(lossy, 1, "a")
    rate = path.rate_bps
    assert {rate.at(t) for t in range(0, rate.period_ns, 77 * MS)} == {0, 8_000_000}
    share = rate.integral(0, rate.period_ns) / rate.period_ns / 8e6
    assert 0.7 < share < 0.95  # 6 x 2 s lost in 72 s


def test_outages_go_over_a_trace_of_any_length():
    trace = TraceRate(starts_us=[0, 700_000], rates_bps=[1000, 3000], period_us=1_300_000)
    path = Channel.draw(LinkProfile(rate=trace, outages=Outages(per_minute=2, mean_s=3)), 4, "a")
    plain = Channel.draw(LinkProfile(rate=trace), 4, "a")
    moments = range(0, path.rate_bps.period_ns, 77 * MS)
    assert any(path.rate_bps.at(t) == 0 for t in moments)
    for t in moments:
        assert path.rate_bps.at(t) in (0, plain.rate_bps.at(t))


def test_outages_cost_no_more_on_a_trace_of_milliseconds():
    trace = TraceRate(starts_us=[0, 1000], rates_bps=[2000, 6000], period_us=2000)
    begin = time.thread_time_ns()
    path = Channel.draw(LinkProfile(rate=trace, outages=Outages(per_minute=6, mean_s=2)), 4, "a")
    assert time.thread_time_ns() - begin < 100 * MS
    assert 0 < path.rate_bps.integral(0, path.rate_bps.period_ns) < 4000 * path.rate_bps.period_ns


def test_a_message_under_way_for_hours_is_timed_at_once():
    trace = TraceRate(starts_us=[0, 1000], rates_bps=[2000, 0], rtt_us=[9, 5], period_us=2000)
    path = Channel.draw(LinkProfile(rate=trace), 1, "a")
    begin = time.thread_time_ns()
    assert path.arrival_ns(0, 100_000_000 * MS) == 100_000_000 * MS + 4500
    assert time.thread_time_ns() - begin < 100 * MS
