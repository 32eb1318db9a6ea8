"""Packets are lost as in the profile, and TCP's retransmissions delay the packets behind them."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.traffic import on_air_bytes
from sensing.link_channel import Channel, VirtualLink
from sensing.link_config import profile_named
from sensing.link_profile import LinkProfile, PacketLoss
from sensing.lossy_link import LossyLink, link_over
from sensing.packet_loss import LossPattern
from sensing.tcp_sender import MIN_TIMEOUT_NS, TcpSender
from tests.lost_packets import LostPackets

MS = 1_000_000


def channel(name: str) -> Channel:
    return Channel.draw(profile_named(name) or LinkProfile(), 3, "cav")


def delays_ms(name: str, *lost: int, size: int = 33_000, messages: int = 5) -> list[float]:
    """Returns the delay of a message every 200 ms."""
    link = LossyLink(channel(name), LostPackets(*lost))
    return [round(link.send(200 * MS * n, size).latency_ns / MS, 1) for n in range(messages)]


def test_a_share_of_all_packets_is_lost_independently_or_in_bursts_of_the_mean_length():
    for loss in (PacketLoss.independent(0.02), PacketLoss.in_bursts(0.02, 4)):
        pattern = LossPattern(loss, 1, "a")
        lost = [pattern[n] for n in range(60_000)]
        bursts = sum(b and not a for a, b in pairwise(lost))
        assert sum(lost) / len(lost) == pytest.approx(loss.share, rel=0.15)
        assert sum(lost) / bursts == pytest.approx(1 / loss.bad_to_good, rel=0.15)
    assert loss.share == pytest.approx(0.02)


def test_a_pattern_depends_on_seed_and_agent_alone_and_may_be_read_in_any_order():
    def drawn(seed: int, agent: str, numbers: range) -> list[bool]:
        pattern = LossPattern(PacketLoss.independent(0.3), seed, agent)
        return [pattern[n] for n in numbers]

    ahead, back = range(20_000), range(19_999, -1, -1)
    assert drawn(1, "a", ahead) == drawn(1, "a", back)[::-1]
    assert drawn(1, "a", ahead) != drawn(2, "a", ahead)
    assert drawn(1, "a", ahead) != drawn(1, "b", ahead)


def test_without_a_loss_a_message_that_the_window_holds_takes_as_long_as_on_a_link_without_tcp():
    first, *rest = delays_ms("6mbit,50ms")
    plain = VirtualLink(channel("6mbit,50ms")).send(0, 33_000).latency_ns / MS
    assert first > plain + 30  # ten packets leave at once, the rest a round trip later
    assert rest == pytest.approx([plain] * 4, abs=0.1)


def test_a_packet_lost_in_the_middle_comes_a_round_trip_later_and_holds_up_those_behind_it():
    assert delays_ms("6mbit,50ms", 30)[1] == pytest.approx(70.6 + 30, abs=5)


def test_a_tail_that_is_lost_waits_for_a_probe_and_a_lost_probe_for_the_timeout():
    plain, probed, timed_out = (
        delays_ms("6mbit,50ms", *lost, size=4_000, messages=1)[0] for lost in ((), (2,), (2, 3))
    )
    assert probed == pytest.approx(plain + 100 + 200, abs=60)  # the kernel's wait of a lone packet
    assert timed_out > probed + MIN_TIMEOUT_NS / MS


def test_a_frame_that_follows_makes_the_loss_of_a_tail_known():
    *_, plain = delays_ms("6mbit,50ms", size=4_000, messages=3)
    *_, lost = delays_ms("6mbit,50ms", 8, 9, size=4_000, messages=3)
    assert lost == pytest.approx(plain + 250, abs=20)  # 200 ms until it comes, a round trip


def test_a_loss_shrinks_the_window_so_that_later_messages_take_more_round_trips():
    calm, lossy = (delays_ms("6mbit,50ms", *lost, messages=8) for lost in ((), (30, 60, 90)))
    assert lossy[-1] > calm[-1] + 20


def test_the_kernels_delays_with_the_same_packets_lost_are_met():
    """Measured over `tests.kernel_path`, CUBIC of Linux 6.18."""
    lost = (54, 104, 105, 156, 208, 259, 260, 261)
    sender = TcpSender(channel("3mbit,100ms"), LostPackets(*lost))
    last = []
    for number in range(54):
        sender.advance(200 * MS * number)
        last.append(sender.write(7000))
    sender.advance(20_000 * MS)
    arrivals = {one.end_byte: one.arrival_ns / MS for one in sender.delivered}
    found = [arrivals[end] - 200 * number for number, end in enumerate(last)]
    kernel = {9: 69.5, 10: 357.9, 11: 157.9, 12: 69.5, 20: 365.7, 21: 165.7, 22: 161.8}
    kernel |= {23: 69.5, 30: 203.1, 31: 214.9, 32: 118.5, 40: 357.9, 42: 161.9, 53: 81.5}
    for number, delay_ms in kernel.items():
        assert found[number] == pytest.approx(delay_ms, abs=3)


SENDS = st.lists(st.tuples(st.integers(0, 300 * MS), st.integers(1, 60_000)), max_size=12)
LINKS = ("6mbit,50ms,2%", "1mbit,20ms,5%x3", "50mbit,10ms,0.5%x2", "lte")


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(LINKS), SENDS)
def test_no_message_arrives_before_the_link_could_carry_it(name, sends):
    made, now = channel(name), 0
    link = link_over(made)
    for gap, size in sends:
        now += gap
        sent = link.send(now, size)
        assert sent.first_bit_ns >= now
        assert sent.on_air_bytes >= on_air_bytes(size)
        assert made.rate_bps.integral(now, sent.arrival_ns) >= 8 * on_air_bytes(size) * 10**9


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 400 * MS), st.integers(1, 400))
def test_what_has_not_begun_to_leave_can_be_taken_back(time_ns, seed):
    link = LossyLink(channel("1mbit,40ms"), LossPattern(PacketLoss.independent(0.05), seed, "a"))
    sent = [link.send(0, 15_000, recallable=True) for _ in range(4)]
    recalled = link.recall(time_ns)
    assert recalled == sent[::-1][: len(recalled)]
    assert len(recalled) < 4
    assert link.send(time_ns, 15_000).first_bit_ns >= sent[3 - len(recalled)].first_bit_ns


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(LINKS[:3]), SENDS, st.integers(1, 1000))
def test_all_that_is_written_is_delivered_once_and_in_order(name, sends, seed):
    sender = TcpSender(channel(name), LossPattern(PacketLoss.in_bursts(0.1, 2), seed, "a"))
    now = 0
    for gap, size in sends:
        now += gap
        sender.advance(now)
        sender.write(size)
    while not sender.is_done:
        sender.step()
    ends = [0, *(one.end_byte for one in sender.delivered)]
    arrivals = [one.arrival_ns for one in sender.delivered]
    assert arrivals == sorted(arrivals)
    assert ends[-1] == sum(size for _, size in sends)
    firsts = [one for one in sender.transmitted if one.is_first]
    assert [(one.begin_byte, one.size_bytes) for one in firsts] == [
        (begin, end - begin) for begin, end in pairwise(ends)
    ]


def test_a_pose_that_is_lost_is_known_by_the_scan_that_follows_it():
    link = LossyLink(channel("6mbit,50ms"), LostPackets(11))
    delays = []
    for n in range(2):
        delays += [
            link.send(200 * MS * n, 300).latency_ns,
            link.send(200 * MS * n, 14_000, recallable=True).latency_ns,
        ]
    assert delays[2] == pytest.approx(82 * MS, abs=3 * MS)  # not the 300 ms of a probe


def test_a_link_may_be_named_with_its_loss():
    alone, bursts = profile_named("6mbit,50ms,1%"), profile_named("6mbit,1.5%x4")
    assert alone is not None
    assert bursts is not None
    assert alone.loss == PacketLoss(loss_in_good=0.01)
    assert bursts.loss.share == pytest.approx(0.015)
    assert bursts.loss.bad_to_good == 0.25
    for wrong in ("6mbit,50ms,40%", "6mbit,1%x0.5", "6mbit,1%x90"):
        with pytest.raises(ConfigError, match="at most 30%"):
            profile_named(wrong)
    with pytest.raises(ValueError, match=r"0\.333 of all packets are lost"):
        PacketLoss(good_to_bad=0.5)
