"""Kernel counters of a TCP connection of this process (TCP_INFO, Linux)."""

from __future__ import annotations

import os
import socket
import struct
from functools import lru_cache
from pathlib import Path

from protocol.traffic import HEADER_BYTES, PACKETS_PER_ACK, Traffic, packets_of

# Offsets in struct tcp_info, linux/tcp.h since 4.19.
_BYTES_RECEIVED = 128
_SEGMENTS = (136, struct.Struct("@II"))  # out and in, bare acknowledgements included
_DATA_SEGMENTS = (152, struct.Struct("@II"))  # in and out
_NOTSENT_BYTES = (144, struct.Struct("@I"))
_BYTES_SENT = (200, struct.Struct("@Q"))


def sent_bytes(locator: str) -> int:
    """Returns TCP payload bytes sent from a local `tcp/HOST:PORT`, retransmissions included.

    Headers of TCP and IP are not in it. 0 if there is no such socket or the kernel is too old.
    """
    return _read(locator, *_BYTES_SENT)


def unsent_bytes(locator: str) -> int:
    """Returns the bytes that wait in the kernel for the other side's window; 0 as above."""
    return _read(locator, *_NOTSENT_BYTES)


def traffic(locator: str) -> Traffic:
    """Returns the traffic so far of a connection from a local `tcp/HOST:PORT`, in both directions.

    Packets are counted as if the path's MTU were 1500: over loopback they are larger, and fewer.
    """
    info = _info(locator)
    if len(info) < _BYTES_SENT[0] + _BYTES_SENT[1].size:
        return Traffic()
    (sent,) = _BYTES_SENT[1].unpack_from(info, _BYTES_SENT[0])
    (received,) = _BYTES_SENT[1].unpack_from(info, _BYTES_RECEIVED)
    out, in_ = _SEGMENTS[1].unpack_from(info, _SEGMENTS[0])
    data_in, data_out = _DATA_SEGMENTS[1].unpack_from(info, _DATA_SEGMENTS[0])
    return Traffic(
        sent + HEADER_BYTES * max(data_out, packets_of(sent)),
        received + HEADER_BYTES * max(data_in, packets_of(received)),
        HEADER_BYTES * _acks(out - data_out, data_in, received),
        HEADER_BYTES * _acks(in_ - data_in, data_out, sent),
    )


def _acks(bare: int, data_segments: int, size_bytes: int) -> int:
    """Returns how many acknowledgements a path of MTU 1500 would carry for so many bytes."""
    missing = packets_of(size_bytes) - data_segments
    return bare + max(0, missing) // PACKETS_PER_ACK


def _read(locator: str, offset: int, number: struct.Struct) -> int:
    info = _info(locator)
    if len(info) < offset + number.size:
        return 0
    return int(number.unpack_from(info, offset)[0])


def _info(locator: str) -> bytes:
    """Returns struct tcp_info; empty if there is no such socket."""
    port = locator.rsplit(":", 1)[-1].split("?")[0].split("#")[0]
    connection = _socket_at(int(port)) if port.isdigit() else None
    if connection is None:
        return b""
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 232)


@lru_cache(maxsize=1024)
def _socket_at(port: int) -> socket.socket | None:
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if not str(entry.readlink()).startswith("socket:"):
                continue
            found = socket.socket(fileno=os.dup(int(entry.name)))
        except OSError:
            continue
        if _is_connection_from(found, port):
            return found
        found.close()
    return None


def _is_connection_from(candidate: socket.socket, port: int) -> bool:
    if candidate.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    try:
        candidate.getpeername()
        return bool(candidate.getsockname()[1] == port)
    except OSError:
        return False
