"""Model of a TCP sender over a channel that loses packets: arrival times in simulated time.

The sender of Linux 6, as far as it decides delays: selective acknowledgements, RACK and tail loss
probes (RFC 8985), retransmission timeouts (RFC 6298, 200 ms at least), congestion control, timers
of 4 ms, packets that leave in pairs. What waits is one stream: the tail of a message shares its
packet with the next. The receiver delivers in order, so that a lost packet holds up all behind it,
and acknowledges every second full packet, the last of a message and whatever is out of order at
once. Acknowledgements are not lost, and no packet overtakes another. The queue before the channel
has no limit.

No clock is read: `advance` carries out all events until a time. A fork that is advanced further
predicts the future, if nothing more is written.
"""

from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import dataclass
from enum import Enum, auto

from protocol.traffic import SEGMENT_BYTES
from sensing.congestion_control import Acknowledged, Cubic
from sensing.link_channel import Channel
from sensing.packet_loss import LossPattern

DELAYED_ACK_NS = 40_000_000  # of a single full packet
MIN_TIMEOUT_NS = 200_000_000
MAX_TIMEOUT_NS = 120_000_000_000
_FIRST_TIMEOUT_NS = 1_000_000_000  # before a round trip is known
_LEAST_TIMER_NS = 2_000_000  # the kernel adds it to a probe's and to a reordering wait
# The kernel's timers wait for the tick (HZ 250) after they are due, long ones for an eighth one.
_TICK_NS = 4_000_000
_FINE_TICKS, _COARSE_TICKS = 64, 8
_DUPLICATES = 3  # packets acknowledged selectively, from which on a gap is a loss at once
_LEAST_BURST = 2  # packets that the kernel hands to a device at once; more above 36 Mbit/s
_SOON_NS = 1_000_000
_MAX_BACKOFF = 9  # doublings of a timeout


@dataclass(slots=True)
class _Segment:
    """A packet's payload, from its first transmission until it is acknowledged."""

    size_bytes: int
    end_byte: int
    sent_ns: int = -1
    transmissions: int = 0
    is_sacked: bool = False
    is_lost: bool = False


@dataclass(frozen=True, slots=True)
class Transmitted:
    """Bytes of the stream on the channel, in one packet; `is_first` if it is no repetition."""

    begin_byte: int
    size_bytes: int
    first_bit_ns: int
    last_bit_ns: int
    is_first: bool


@dataclass(frozen=True, slots=True)
class Delivered:
    """Up to where the receiver has read the stream."""

    end_byte: int
    arrival_ns: int


@dataclass(frozen=True, slots=True)
class _Ack:
    """An acknowledgement: the segment that caused it, and the end of what had arrived in order."""

    time_ns: int
    segment: int
    next_expected: int


class _State(Enum):
    OPEN = auto()
    RECOVERY = auto()
    LOSS = auto()  # after a timeout


class _Timer(Enum):
    REORDER = auto()
    PROBE = auto()
    TIMEOUT = auto()


@dataclass(slots=True)
class _RoundTrip:
    """Smoothed round trip and retransmission timeout."""

    smoothed_ns: int = 0
    variance_ns: int = 0
    least_ns: int = 0

    def add(self, sample_ns: int) -> None:
        if self.smoothed_ns == 0:
            self.smoothed_ns, self.variance_ns = sample_ns, sample_ns // 2
            self.least_ns = sample_ns
            return
        self.variance_ns += (abs(sample_ns - self.smoothed_ns) - self.variance_ns) // 4
        self.smoothed_ns += (sample_ns - self.smoothed_ns) // 8
        self.least_ns = min(self.least_ns, sample_ns)

    @property
    def timeout_ns(self) -> int:
        if self.smoothed_ns == 0:
            return _FIRST_TIMEOUT_NS
        wait_ns = self.smoothed_ns + max(4 * self.variance_ns, MIN_TIMEOUT_NS)
        return min(-(-wait_ns // _TICK_NS) * _TICK_NS, MAX_TIMEOUT_NS)


class TcpSender:
    """One direction of a connection, from the first write to the last delivery.

    `transmitted` and `delivered` collect events; the reader clears them.
    """

    def __init__(self, channel: Channel, losses: LossPattern) -> None:
        self.transmitted: list[Transmitted] = []
        self.delivered: list[Delivered] = []
        self._channel = channel
        self._losses = losses
        self._congestion = Cubic()
        self._round_trip = _RoundTrip()
        self._round_trip.add(2 * channel.delay_ns(0))  # of the handshake
        self._now_ns = 0
        # Segments by number: acknowledged before `_acked`, sent before `_next`.
        self._segments: dict[int, _Segment] = {}
        self._acked = self._next = 0
        self._sent_bytes = self._written_bytes = 0
        self._in_flight = self._sacked = self._lost = 0
        self._state = _State.OPEN
        self._recovered_at = 0  # the segment up to which a recovery lasts
        self._probed_at: int | None = None  # a tail loss probe waits for this
        self._probe_is_new = False
        self._timer: tuple[int, _Timer] | None = None
        self._reordered_ns: int | None = None  # when a gap counts as a loss
        self._backoff = 0
        self._last_sent_ns = 0
        # RACK: the newest transmission that is known to have arrived.
        self._newest = (-1, -1)  # sent at, segment
        self._newest_rtt_ns = 0
        # The channel and the receiver.
        self._packets = 0
        self._free_ns = self._last_arrival_ns = self._last_ack_ns = 0
        self._expected = self._delivered_bytes = 0
        self._beyond: set[int] = set()
        self._acks: deque[_Ack] = deque()
        self._delayed_ns: int | None = None  # when the last of them leaves, if it waits
        self._unacked_bytes = 0

    def fork(self) -> TcpSender:
        """Returns an independent copy."""
        other = copy(self)
        other.transmitted, other.delivered = list(self.transmitted), list(self.delivered)
        other._segments = {number: copy(one) for number, one in self._segments.items()}
        other._beyond, other._acks = set(self._beyond), deque(self._acks)
        other._round_trip, other._congestion = copy(self._round_trip), copy(self._congestion)
        return other

    @property
    def now_ns(self) -> int:
        """The time until which everything has happened."""
        return self._now_ns

    @property
    def is_done(self) -> bool:
        """Whether all that was written has been acknowledged."""
        return self._acked == self._next and not self._unsent

    def has_delivered(self, end_byte: int) -> bool:
        """Whether it is known when the stream arrives up to here."""
        return end_byte <= self._delivered_bytes

    @property
    def room(self) -> int:
        """How many more full segments fit into the window, or wait to leave with the next."""
        open_window = self._congestion.window - self._in_flight - self._lost
        return max(0, open_window + _LEAST_BURST - self._unsent)

    @property
    def _unsent(self) -> int:
        """How many segments wait for their first transmission."""
        return -(-(self._written_bytes - self._sent_bytes) // SEGMENT_BYTES)

    def write(self, size_bytes: int) -> int:
        """Writes a message now; returns where in the stream it ends.

        It fills the last segment of those that wait, as the kernel does.
        """
        if self.is_done:
            idle_ns = self._now_ns - self._last_sent_ns
            self._congestion.on_idle(self._now_ns, idle_ns, self._round_trip.timeout_ns)
        self._written_bytes += size_bytes
        self._send()
        return self._written_bytes

    def withdraw(self, since_byte: int) -> bool:
        """Withdraws what was written from here on; False if some of it has been sent."""
        if since_byte < self._sent_bytes:
            return False
        self._written_bytes = since_byte
        return True

    def advance(self, until_ns: int) -> None:
        """Carries out all that happens until a time, itself included."""
        while (event_ns := self.next_event_ns()) is not None and event_ns <= until_ns:
            self.step()
        self._now_ns = max(self._now_ns, until_ns)

    def next_event_ns(self) -> int | None:
        """Returns when something happens next, None if nothing will."""
        times = [self._acks[0].time_ns] if self._acks else []
        times += [] if self._timer is None else [self._timer[0]]
        return max(self._now_ns, min(times)) if times else None

    def step(self) -> None:
        """Carries out what happens next."""
        event_ns = self.next_event_ns()
        if event_ns is None:
            return
        self._now_ns = event_ns
        if self._acks and self._acks[0].time_ns <= event_ns:
            self._take(self._acks.popleft())
        elif self._timer is not None:
            _, timer = self._timer
            self._timer = None
            if timer is _Timer.REORDER:
                self._give_up_reordered()
            elif timer is _Timer.PROBE:
                self._probe()
            else:
                self._time_out()
        self._send()

    # Sending

    def _send(self) -> None:
        """Sends what the window takes: first what was lost, then what is new."""
        first_new, sent, is_deferred = self._next, 0, False
        while self._lost and self._has_window():
            number = next(n for n in range(self._acked, self._next) if self._segments[n].is_lost)
            self._segments[number].is_lost = False
            self._lost -= 1
            self._transmit(number)
            sent += 1
        while self._unsent and self._has_window():
            if is_deferred := self._waits_for_ack():
                break
            for _ in range(self._burst):
                self._transmit(self._segment_next())
                sent += 1
        is_limited = is_deferred or not self._has_window()
        if self._next > first_new or (is_limited and self._unsent):
            self._congestion.on_new_data(
                self._now_ns,
                self._acked,
                self._next,
                is_limited=is_limited,
                timeout_ns=self._round_trip.timeout_ns,
                is_open=self._state is _State.OPEN,
            )
        if sent:
            self._arm()

    def _segment_next(self) -> int:
        """Cuts the next segment off what waits; returns its number."""
        size_bytes = min(SEGMENT_BYTES, self._written_bytes - self._sent_bytes)
        self._sent_bytes += size_bytes
        self._segments[self._next] = _Segment(size_bytes, self._sent_bytes)
        self._next += 1
        return self._next - 1

    @property
    def _burst(self) -> int:
        """How many new packets leave together."""
        window = self._congestion.window
        return min(max(1, window // 2), window - self._in_flight, self._unsent, _LEAST_BURST)

    def _waits_for_ack(self) -> bool:
        """Whether what little window is left waits for an acknowledgement that is due.

        The kernel hands packets on in pairs at least (segmentation offload): the first of two
        waits, right after others have left, if it may soon be sent together with the second.
        """
        room = self._congestion.window - self._in_flight
        if (
            self._state is not _State.OPEN
            or self._next == self._acked
            or self._unsent < _LEAST_BURST
            or room >= _LEAST_BURST
            or 3 * room >= self._congestion.window
            or self._now_ns - self._last_sent_ns > _SOON_NS
        ):
            return False
        smoothed_ns = self._round_trip.smoothed_ns
        due_ns = self._segments[self._acked].sent_ns + smoothed_ns
        return due_ns - self._now_ns <= min(smoothed_ns // 2, _SOON_NS)

    def _has_window(self) -> bool:
        return self._in_flight < self._congestion.window

    def _transmit(self, number: int) -> None:
        segment = self._segments[number]
        is_first = segment.transmissions == 0
        if is_first and self._next - self._acked == 1:
            self._congestion.on_start(self._now_ns, self._now_ns - self._last_sent_ns)
        segment.sent_ns = self._last_sent_ns = self._now_ns
        segment.transmissions += 1
        self._in_flight += 1
        self._congestion.on_transmit()
        begin_ns = max(self._now_ns, self._free_ns)
        self._free_ns = self._channel.departure_ns(begin_ns, segment.size_bytes)
        self.transmitted.append(
            Transmitted(
                segment.end_byte - segment.size_bytes,
                segment.size_bytes,
                begin_ns,
                self._free_ns,
                is_first,
            )
        )
        packet, self._packets = self._packets, self._packets + 1
        if not self._losses[packet]:
            arrival_ns = self._free_ns + self._channel.delay_ns(self._free_ns)
            self._arrive(number, segment.size_bytes, max(arrival_ns, self._last_arrival_ns))

    def _arrive(self, number: int, size_bytes: int, arrival_ns: int) -> None:
        """The receiver delivers in order and acknowledges."""
        self._last_arrival_ns = arrival_ns
        is_next = number == self._expected and not self._beyond
        if number >= self._expected:
            self._beyond.add(number)
        while self._expected in self._beyond:
            self._beyond.remove(self._expected)
            self._delivered_bytes = self._segments[self._expected].end_byte
            self.delivered.append(Delivered(self._delivered_bytes, arrival_ns))
            self._expected += 1
        if self._delayed_ns is not None and arrival_ns <= self._delayed_ns:
            self._acks.pop()  # one acknowledgement for both
        self._delayed_ns = None
        self._unacked_bytes += size_bytes
        answer_ns = arrival_ns
        if is_next and size_bytes == SEGMENT_BYTES == self._unacked_bytes:
            answer_ns = self._delayed_ns = arrival_ns + DELAYED_ACK_NS
        else:
            self._unacked_bytes = 0
        ack_ns = max(answer_ns + self._channel.delay_ns(answer_ns), self._last_ack_ns)
        if self._delayed_ns is None:
            self._last_ack_ns = ack_ns
        self._acks.append(_Ack(ack_ns, number, self._expected))

    # Acknowledgements

    def _take(self, ack: _Ack) -> None:
        is_advanced = ack.next_expected > self._acked
        delivered, sample_ns = self._mark_arrived(ack)
        if sample_ns is not None:
            self._round_trip.add(sample_ns)
        if is_advanced:
            self._backoff = 0
        newly_lost = self._find_lost()
        self._conclude_probe(ack)
        self._enter_or_leave_recovery()
        self._congestion.on_ack(
            Acknowledged(
                now_ns=self._now_ns,
                delivered=delivered,
                newly_lost=newly_lost,
                in_flight=self._in_flight,
                is_advanced=is_advanced,
                least_rtt_ns=self._round_trip.least_ns,
                is_recovering=self._state is _State.RECOVERY,
            )
        )
        self._arm()

    def _mark_arrived(self, ack: _Ack) -> tuple[int, int | None]:
        """Returns how many packets it acknowledges, and a round trip if one was sent once only."""
        sample_ns: int | None = None
        numbers = list(range(self._acked, ack.next_expected))
        if ack.segment >= ack.next_expected:
            numbers.append(ack.segment)
        arrived = [number for number in numbers if not self._segments[number].is_sacked]
        for number in arrived:
            segment = self._segments[number]
            self._in_flight -= not segment.is_lost
            self._lost -= segment.is_lost
            segment.is_sacked, segment.is_lost = True, False
            self._sacked += 1
            rtt_ns = self._now_ns - segment.sent_ns
            if segment.transmissions == 1:
                sample_ns = rtt_ns if sample_ns is None else sample_ns
            elif rtt_ns < self._round_trip.least_ns:
                continue  # it was an earlier transmission
            if (segment.sent_ns, number) > self._newest:
                self._newest, self._newest_rtt_ns = (segment.sent_ns, number), rtt_ns
        for number in range(self._acked, ack.next_expected):
            del self._segments[number]
            self._sacked -= 1
        self._acked = max(self._acked, ack.next_expected)
        return len(arrived), sample_ns

    def _find_lost(self) -> int:
        """Marks the packets that RACK considers lost; returns their number."""
        self._reordered_ns = None
        if self._newest_rtt_ns == 0:
            return 0
        wait_ns, found = self._newest_rtt_ns + self._reordering_ns(), 0
        for number in range(self._acked, self._next):
            segment = self._segments[number]
            if segment.is_sacked or segment.is_lost or (segment.sent_ns, number) > self._newest:
                continue
            due_ns = segment.sent_ns + wait_ns
            if due_ns <= self._now_ns:
                self._mark_lost(segment)
                found += 1
            else:
                self._reordered_ns = max(self._reordered_ns or 0, due_ns + _LEAST_TIMER_NS)
        return found

    def _reordering_ns(self) -> int:
        """Returns how long a packet may be overtaken before it counts as lost."""
        if self._state is not _State.OPEN or self._sacked >= _DUPLICATES:
            return 0
        return min(self._round_trip.least_ns // 4, self._round_trip.smoothed_ns)

    def _mark_lost(self, segment: _Segment) -> None:
        segment.is_lost = True
        self._lost += 1
        self._in_flight -= 1

    def _enter_or_leave_recovery(self) -> None:
        if self._state is not _State.OPEN and self._acked >= self._recovered_at:
            if self._state is _State.RECOVERY:
                self._congestion.on_recovered()
            self._state = _State.OPEN
        if self._state is _State.OPEN and self._lost:
            self._state = _State.RECOVERY
            self._recovered_at = self._next
            self._probed_at = None
            self._congestion.on_loss()

    def _conclude_probe(self, ack: _Ack) -> None:
        """A probe that arrived has repaired a loss, which counts as one."""
        if self._probed_at is None or ack.next_expected < self._probed_at:
            return
        self._probed_at = None
        if not self._probe_is_new and self._state is _State.OPEN:
            self._congestion.on_loss()
            self._congestion.on_recovered()

    # Timers

    def _arm(self) -> None:
        """Sets the timer for what comes first: reordering, tail loss probe or timeout."""
        self._timer = None
        if self._next == self._acked:
            return
        if self._reordered_ns is not None:
            self._set_timer(self._reordered_ns, _Timer.REORDER)
            return
        timeout_ns = self._round_trip.timeout_ns << self._backoff
        timeout_at_ns = self._segments[self._acked].sent_ns + timeout_ns
        if self._state is not _State.OPEN or self._probed_at is not None or self._sacked:
            self._set_timer(timeout_at_ns, _Timer.TIMEOUT)
            return
        wait_ns = 2 * self._round_trip.smoothed_ns or _FIRST_TIMEOUT_NS
        wait_ns += MIN_TIMEOUT_NS if self._next - self._acked == 1 else _LEAST_TIMER_NS
        self._set_timer(min(self._now_ns + wait_ns, timeout_at_ns), _Timer.PROBE)

    def _set_timer(self, due_ns: int, timer: _Timer) -> None:
        ticks = max(1, -(-(due_ns - self._now_ns) // _TICK_NS))
        step = _TICK_NS if ticks < _FINE_TICKS else _COARSE_TICKS * _TICK_NS
        expiry_ns = (self._now_ns // _TICK_NS + ticks) * _TICK_NS
        self._timer = ((expiry_ns // step + 1) * step, timer)

    def _give_up_reordered(self) -> None:
        if self._find_lost() and self._state is _State.OPEN:
            self._enter_or_leave_recovery()
            self._congestion.on_late_loss(self._in_flight)
        self._arm()

    def _probe(self) -> None:
        """Sends the next new packet, or the last one again, to learn whether the tail is lost."""
        self._probe_is_new = self._unsent > 0
        if self._probe_is_new:
            number = self._segment_next()
        else:
            number = self._next - 1
            self._in_flight -= 1  # the kernel does not count a repeated probe
        self._probed_at = self._next
        self._transmit(number)
        self._set_timer(self._now_ns + self._round_trip.timeout_ns, _Timer.TIMEOUT)

    def _time_out(self) -> None:
        for number in range(self._acked, self._next):
            segment = self._segments[number]
            is_recent = segment.sent_ns + self._newest_rtt_ns > self._now_ns
            if segment.is_sacked or segment.is_lost or (is_recent and number != self._acked):
                continue
            self._mark_lost(segment)
        is_first = self._state is _State.OPEN or (self._state is _State.LOSS and not self._backoff)
        self._congestion.on_timeout(self._in_flight, is_first=is_first)
        self._state = _State.LOSS
        self._recovered_at = self._next
        self._probed_at = self._reordered_ns = None
        self._backoff = min(self._backoff + 1, _MAX_BACKOFF)
