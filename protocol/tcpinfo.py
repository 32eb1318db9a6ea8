"""What the kernel knows of a TCP connection of this process (TCP_INFO, Linux)."""

from __future__ import annotations

import os
import socket
import struct
from functools import lru_cache
from pathlib import Path

# Offsets in struct tcp_info, linux/tcp.h since 4.19.
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


def _read(locator: str, offset: int, number: struct.Struct) -> int:
    port = locator.rsplit(":", 1)[-1].split("?")[0].split("#")[0]
    connection = _socket_at(int(port)) if port.isdigit() else None
    if connection is None:
        return 0
    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 232)
    if len(info) < offset + number.size:
        return 0
    return int(number.unpack_from(info, offset)[0])


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
