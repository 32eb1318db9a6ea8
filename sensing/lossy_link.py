"""A virtual link with packet loss and TCP's retransmissions, in simulated time."""

from __future__ import annotations

from protocol.messages import MAX_DELAY_NS
from protocol.traffic import on_air_bytes
from sensing.link_channel import Channel, Transmission, VirtualLink
from sensing.packet_loss import LossPattern
from sensing.tcp_sender import TcpSender

LEAST_INTERVAL_NS = 10_000_000  # of frames that are expected to follow


class LossyLink:
    """A connection over a channel that loses packets; no clock is read.

    A message's arrival is predicted as it is sent. It depends on later packets, which reveal the
    loss of a message's last ones: assumed are the chunk that follows a pose, and frames of the last
    one's size at the last ones' interval. A later message may be predicted to arrive before it.
    """

    def __init__(self, channel: Channel, losses: LossPattern) -> None:
        self._channel = channel
        self._sender = TcpSender(channel, losses)
        self._last: Transmission | None = None
        self._chunk_bytes = 0  # of the last one
        self._interval_ns = 0  # between the last two frames
        self._frame_bytes = self._last_frame_bytes = 0
        # Where each begins in the stream, and what was the last before it.
        self._recallable: list[tuple[int, Transmission, Transmission | None]] = []

    def send(self, now_ns: int, size_bytes: int, *, recallable: bool = False) -> Transmission:
        """See `VirtualLink.send`; the bytes on the air are those of all repetitions.

        The header of a packet that two messages share counts for both.
        """
        if self._last is None or now_ns > self._last.sent_ns:
            gap_ns = 0 if self._last is None else now_ns - self._last.sent_ns
            self._interval_ns = gap_ns if gap_ns >= LEAST_INTERVAL_NS else 0
            self._last_frame_bytes, self._frame_bytes = self._frame_bytes, 0
        self._frame_bytes += size_bytes
        self._sender.advance(now_ns)
        self._sender.transmitted.clear()
        self._sender.delivered.clear()
        end_byte = self._sender.write(size_bytes)
        begin_byte = end_byte - size_bytes
        following_bytes = 0 if recallable else self._chunk_bytes
        transmission = self._forecast(now_ns, begin_byte, end_byte, following_bytes)
        if recallable:
            self._chunk_bytes = size_bytes
            self._recallable.append((begin_byte, transmission, self._last))
        else:
            self._recallable.clear()
        self._last = transmission
        return transmission

    def _forecast(
        self, now_ns: int, begin_byte: int, end_byte: int, following_bytes: int
    ) -> Transmission:
        future, latest_ns = self._sender.fork(), now_ns + MAX_DELAY_NS
        future.write(following_bytes)
        frame_ns = now_ns + (self._interval_ns or MAX_DELAY_NS)
        while not (future.has_delivered(end_byte) or future.now_ns > latest_ns):
            event_ns = future.next_event_ns()
            if event_ns is None or event_ns > frame_ns:
                future.advance(frame_ns)
                future.write(self._last_frame_bytes)
                frame_ns += self._interval_ns or MAX_DELAY_NS
            else:
                future.step()
        arrivals_ns = (one.arrival_ns for one in future.delivered if one.end_byte >= end_byte)
        mine = [
            (one, min(one.begin_byte + one.size_bytes, end_byte) - max(one.begin_byte, begin_byte))
            for one in future.transmitted
            if one.begin_byte < end_byte and one.begin_byte + one.size_bytes > begin_byte
        ]
        return Transmission(
            sent_ns=now_ns,
            first_bit_ns=mine[0][0].first_bit_ns if mine else latest_ns,
            last_bit_ns=max(
                (one.last_bit_ns for one, _ in mine if one.is_first), default=latest_ns
            ),
            arrival_ns=next(arrivals_ns, latest_ns),
            on_air_bytes=sum(on_air_bytes(own_bytes) for _, own_bytes in mine),
        )

    def recall(self, time_ns: int) -> list[Transmission]:
        """See `VirtualLink.recall`."""
        self._sender.advance(time_ns)
        recalled = []
        while self._recallable and self._sender.withdraw(self._recallable[-1][0]):
            _, transmission, self._last = self._recallable.pop()
            recalled.append(transmission)
        self._recallable.clear()
        return recalled

    def backlog_ns(self, now_ns: int) -> int:
        """See `VirtualLink.backlog_ns`; what is sent again is not counted."""
        return 0 if self._last is None else max(0, self._last.last_bit_ns - now_ns)

    def delay_ns(self, time_ns: int) -> int:
        """See `VirtualLink.delay_ns`."""
        return self._channel.delay_ns(time_ns)


def link_over(channel: Channel) -> VirtualLink | LossyLink:
    """Returns the link in simulated time over a channel."""
    return VirtualLink(channel) if channel.losses is None else LossyLink(channel, channel.losses)
