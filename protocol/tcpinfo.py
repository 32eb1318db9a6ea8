"""Bytes that the kernel sent for a TCP connection of this process (TCP_INFO, Linux)."""

from __future__ import annotations

import os
import socket
import struct
from functools import lru_cache
from pathlib import Path

_BYTES_SENT = struct.Struct("@Q")
_OFFSET = 200  # of tcpi_bytes_sent in struct tcp_info, linux/tcp.h since 4.19


def sent_bytes(locator: str) -> int:
    """Returns TCP payload bytes sent from a local `tcp/HOST:PORT`, retransmissions included.

    Headers of TCP and IP are not in it. 0 if there is no such socket or the kernel is too old.
    """
    port = locator.rsplit(":", 1)[-1].split("?")[0].split("#")[0]
    connection = _socket_at(int(port)) if port.isdigit() else None
    if connection is None:
        return 0
    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 232)
    return int(_BYTES_SENT.unpack_from(info, _OFFSET)[0]) if len(info) >= _OFFSET + 8 else 0


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
