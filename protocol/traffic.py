"""Bytes on the wire: the IP packets of 1500 bytes that messages take, in both directions.

A link carries more than the payload. On top come, by layer: the message's own header, its key and
Zenoh's framing; records of TLS; headers of TCP and IP; acknowledgements, one for every second
packet. Where the transport is real, the kernel counts (`protocol.tcpinfo`); within one process the
same is computed from these constants (a test compares the two).
"""

from __future__ import annotations

from dataclasses import dataclass

HEADER_BYTES = 52  # TCP with time stamps over IPv4
SEGMENT_BYTES = 1448  # of payload in a packet of 1500 bytes
FRAMING_BYTES = (
    9  # Zenoh 1: length of a batch, sequence number, header of a put; the key comes on top
)
PACKETS_PER_ACK = 2  # RFC 9293: at least every second full packet


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes of IP packets so far: those with data, and bare acknowledgements, by direction."""

    data_sent_bytes: int = 0
    data_received_bytes: int = 0
    acks_sent_bytes: int = 0
    acks_received_bytes: int = 0

    @property
    def sent_bytes(self) -> int:
        """All that was sent."""
        return self.data_sent_bytes + self.acks_sent_bytes

    @property
    def received_bytes(self) -> int:
        """All that was received."""
        return self.data_received_bytes + self.acks_received_bytes

    def sent(self, size_bytes: int) -> Traffic:
        """Returns the traffic with one more message that was sent."""
        return Traffic(
            self.data_sent_bytes + on_air_bytes(size_bytes),
            self.data_received_bytes,
            self.acks_sent_bytes,
            self.acks_received_bytes + _ack_bytes(size_bytes),
        )

    def received(self, size_bytes: int) -> Traffic:
        """Returns the traffic with one more message that was received."""
        return Traffic(
            self.data_sent_bytes,
            self.data_received_bytes + on_air_bytes(size_bytes),
            self.acks_sent_bytes + _ack_bytes(size_bytes),
            self.acks_received_bytes,
        )


def packets_of(size_bytes: int) -> int:
    """Returns the number of packets of a TCP payload."""
    return -(-size_bytes // SEGMENT_BYTES)


def on_air_bytes(size_bytes: int) -> int:
    """Returns the bytes of a TCP payload on the link, with the headers of TCP and IP."""
    return size_bytes + HEADER_BYTES * packets_of(size_bytes)


def framed_bytes(key: str, message_bytes: int) -> int:
    """Returns the TCP payload of an encoded message that is published with a key."""
    return message_bytes + len(key.encode()) + FRAMING_BYTES


def _ack_bytes(size_bytes: int) -> int:
    return HEADER_BYTES * -(-packets_of(size_bytes) // PACKETS_PER_ACK)
