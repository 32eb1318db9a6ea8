"""What the kernel counts, and how much a socket takes."""

from __future__ import annotations

import socket

from cpnet.doctor.finding import Finding
from protocol.bus import SEND_BUFFER_BYTES
from protocol.tcpinfo import sent_bytes_of

_SAMPLE_BYTES = 1000


def counters() -> list[Finding]:
    """Looks whether TCP tells how many bytes a connection has sent."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as sender,
    ):
        sender.sendall(bytes(_SAMPLE_BYTES))
        ok = sent_bytes_of(sender) >= _SAMPLE_BYTES
    advice = "" if ok else "needs Linux 4.19: bytes by TCP and what waits in a link read 0"
    what = "the kernel's count of sent bytes (TCP_INFO)"
    return [Finding("tcp_info", what, ok, advice, optional=True)]


def send_buffer() -> list[Finding]:
    """Looks whether a socket takes a whole scan."""
    with socket.socket() as asked:
        asked.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        granted = asked.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) // 2  # Linux doubles it
    ok = granted >= SEND_BUFFER_BYTES
    tune = f"sysctl -w net.core.wmem_max={SEND_BUFFER_BYTES}"
    advice = "" if ok else f"{tune}: else an agent waits while its link is full"
    what = f"send buffers of {granted >> 10} KiB"
    measured = {"send_buffer_bytes": granted}
    return [Finding("send_buffer", what, ok, advice, optional=True, measured=measured)]
