"""What TCP makes of single lost packets: times of arrival by the standards' rules and the kernel's.

A message of five packets, 7 kB, every 100 ms at 5 Mbit/s and 20 ms: a full packet takes 2.4 ms, the
message 11.6 ms and half a round trip. Acknowledged are every second packet and the last.
"""

import pytest

from sensing.link_channel import Channel
from sensing.link_config import profile_named
from sensing.link_profile import LinkProfile
from sensing.tcp_sender import DELAYED_ACK_NS, MIN_TIMEOUT_NS, TcpSender
from tests.lost_packets import LostPackets

MS = 1_000_000
PLAIN_MS = 21.6  # without loss
PACKET_MS = 2.4
RTT_MS = 20.0
REPEATED_MS = RTT_MS / 2 + PACKET_MS  # a full packet that is sent again, until it arrives
TICK_MS = 4.0  # a kernel's timer is late by two at most
FIRST = 50  # packet of the message in which losses begin: its window has settled


def sender_losing(*lost: int, link: str = "5mbit,20ms") -> TcpSender:
    return TcpSender(
        Channel.draw(profile_named(link) or LinkProfile(), 3, "cav"), LostPackets(*lost)
    )


def delays_ms(*lost: int, messages: int = 14, period_ms: int = 100) -> list[float]:
    """Returns the delays from the tenth message on; lost are packets from its first on."""
    sender = sender_losing(*(FIRST + packet for packet in lost))
    ends = []
    for number in range(messages):
        sender.advance(number * period_ms * MS)
        ends.append(sender.write(7000))
    while not sender.is_done:
        sender.step()
    arrivals = [
        next(one.arrival_ns for one in sender.delivered if one.end_byte >= end) / MS for end in ends
    ]
    return [at - number * period_ms for number, at in enumerate(arrivals)][10:]


@pytest.mark.parametrize("lost", [0, 1])
def test_the_third_packet_behind_a_gap_has_it_repeated_at_once(lost):
    """RFC 6675: three packets acknowledged selectively are a loss."""
    known_ms = (lost + 4) * PACKET_MS + RTT_MS
    known_ms -= 0.4 if lost == 1 else 0  # the message's last packet is smaller
    assert delays_ms(lost)[0] == pytest.approx(known_ms + REPEATED_MS, abs=0.1)


@pytest.mark.parametrize("lost", [2, 3])
def test_with_fewer_behind_it_a_gap_waits_for_a_quarter_of_the_least_round_trip(lost):
    """RFC 8985, 6.2: the reordering window; 2 ms more in the kernel."""
    known_ms = PLAIN_MS + RTT_MS / 2 + RTT_MS / 4 + 2
    found_ms = delays_ms(lost)[0] - REPEATED_MS
    assert known_ms <= found_ms <= known_ms + 2 * TICK_MS


def test_a_lost_tail_is_probed_two_round_trips_after_the_last_acknowledgement():
    """RFC 8985, 7.2: 2 SRTT, here 33 to 35 ms; its answer shows the loss before it."""
    acked_ms = 3 * PACKET_MS + RTT_MS + DELAYED_ACK_NS / MS  # of a single packet
    found_ms = delays_ms(3, 4, period_ms=1000)[0] - 2 * REPEATED_MS - RTT_MS / 2
    assert 2 * 33 <= found_ms - acked_ms <= 2 * 35 + 2 + 2 * TICK_MS


def test_a_lone_lost_packet_is_probed_no_later_than_the_timeout():
    """RFC 8985, 7.2: 200 ms more, for its acknowledgement may be delayed."""
    found_ms = delays_ms(4, period_ms=1000)[0] - (REPEATED_MS - 0.4)
    assert 28 <= found_ms - MIN_TIMEOUT_NS / MS <= 30 + 2 * TICK_MS


def test_a_repetition_that_is_lost_waits_for_the_timeout_which_doubles():
    """RFC 6298: SRTT and 200 ms at least, from the repetition on."""
    once, twice = delays_ms(2, 5, period_ms=1000)[0], delays_ms(2, 5, 6, period_ms=1000)[0]
    least_ms = MIN_TIMEOUT_NS / MS + 28
    assert least_ms <= once - delays_ms(2)[0] <= least_ms + 3 * TICK_MS
    assert 2 * least_ms <= twice - once <= 2 * least_ms + 8 + 9 * TICK_MS  # a coarser tick


def test_an_answered_repetition_shows_the_loss_of_what_was_sent_before_it():
    """RFC 8985, 6.2: no probe is waited for, nor the next message."""
    for lost in ((0, 4), (1, 4), (2, 4)):
        assert delays_ms(*lost)[0] == pytest.approx(delays_ms(lost[0])[0] + RTT_MS + 2, abs=10)


# Delays of this message and the next over `tests.kernel_path`, Linux 6.18, CUBIC: the least of
# three; packets from the fifth on are repetitions or the next message's.
KERNEL_MS = {
    (0,): (42.3, 21.7),
    (1,): (44.4, 21.8),
    (0, 1): (66.9, 21.8),
    (2,): (53.0, 21.8),
    (0, 2): (67.0, 21.8),
    (1, 2): (76.6, 21.8),
    (0, 1, 2): (77.6, 21.8),
    (3,): (53.3, 21.8),
    (0, 3): (67.1, 21.7),
    (1, 3): (76.0, 21.8),
    (0, 1, 3): (78.8, 21.8),
    (2, 3): (75.8, 21.8),
    (0, 2, 3): (77.6, 21.8),
    (1, 2, 3): (77.9, 21.8),
    (0, 1, 2, 3): (99.5, 26.4),
    (4,): (134.8, 34.8),
    (0, 4): (64.6, 21.8),
    (1, 4): (73.0, 21.8),
    (0, 1, 4): (98.2, 27.7),
    (2, 4): (74.8, 21.8),
    (0, 2, 4): (96.9, 26.3),
    (1, 2, 4): (96.9, 26.3),
    (0, 1, 2, 4): (98.8, 28.6),
    (3, 4): (137.2, 37.2),
    (0, 3, 4): (134.2, 63.6),
    (1, 3, 4): (134.0, 63.5),
    (0, 1, 3, 4): (95.8, 27.6),
    (2, 3, 4): (137.6, 37.6),
    (0, 2, 3, 4): (136.8, 68.7),
    (4, 5): (137.3, 39.9),
    (3, 4, 5): (139.8, 42.3),
    (3, 4, 5, 6): (142.0, 62.7),
    (2, 3, 4, 5): (139.5, 39.5),
    (2, 3, 4, 5, 6, 7): (144.2, 65.2),
    (0, 1, 2, 3, 4, 5): (145.1, 45.1),
    (2, 5): (290.5, 240.6),
}


@pytest.mark.parametrize("lost", KERNEL_MS)
def test_the_kernel_with_the_same_packets_lost_takes_as_long(lost):
    assert delays_ms(*lost)[:2] == pytest.approx(KERNEL_MS[lost], abs=TICK_MS)


def test_what_waits_is_one_stream_whose_packets_two_messages_share():
    """70 kB wait after a timeout: full packets but the last, as the kernel sends them."""
    sender = sender_losing(0)
    for _ in range(10):
        sender.write(7000)
    while not sender.is_done:
        sender.step()
    *sizes, last = [one.size_bytes for one in sender.transmitted if one.is_first][10:]
    assert set(sizes) == {1448}
    assert last < 1448


def leaving_at_once(sender: TcpSender, size: int, messages: int) -> list[int]:
    """Writes a message every 100 ms; returns how many packets leave at the time of each write."""
    counts = []
    for number in range(messages):
        sender.advance(number * 100 * MS)
        sender.transmitted.clear()
        sender.write(size)
        counts.append(len(sender.transmitted))
    return counts


def test_the_last_place_in_the_window_waits_for_an_acknowledgement_that_is_overdue():
    """Three of six are out when the next message comes: a pair leaves, the third waits for more."""
    assert leaving_at_once(sender_losing(10, 31, 94, 95, 96, 97), 7000, 20)[-3:] == [5, 5, 2]


def test_a_timeout_within_a_recovery_does_not_shrink_the_window_again():
    sender = sender_losing(52, 55)
    leaving_at_once(sender, 7000, 16)
    sender.advance(2000 * MS)
    sender.transmitted.clear()
    sender.write(40_000)
    assert len(sender.transmitted) == 7  # 0.7 of ten, as after one loss


def test_a_window_that_is_not_used_stays_while_acknowledgements_come():
    sender = sender_losing(200, link="6mbit,50ms")
    leaving_at_once(sender, 33_000, 12)
    sender.advance(1199 * MS)
    room = sender.room
    for number in range(12, 40):
        sender.advance(number * 100 * MS)
        sender.write(33_000)
    sender.advance(3999 * MS)
    assert sender.room == room


def test_timeouts_end_at_ticks_and_long_ones_at_every_eighth():
    sender = sender_losing(*range(4))
    sender.advance(1 * MS)
    sender.write(1448)
    while not sender.is_done:
        sender.step()
    *_, second_ns, third_ns, fourth_ns = [one.first_bit_ns for one in sender.transmitted]
    assert second_ns % (4 * MS) == 0
    assert third_ns % (32 * MS) == fourth_ns % (32 * MS) == 0
