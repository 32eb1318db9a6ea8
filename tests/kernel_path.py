"""A path of rate, delay and packet loss between two TCPs of the kernel, for tests that run as root.

Packets leave one namespace by a TUN device, a process delays and drops them, and they enter another
by a second device: what `tc netem` does, on kernels that lack it. It knows nothing of `sensing`.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import count
from json import dumps
from pathlib import Path

from tests.kernel_links import MTU, KernelError, call, connection_from

_TUNSETIFF = 0x400454CA
_IFF_TUN_NO_PI = 0x1001
_SENDER = (
    (socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"cubic"),
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 21),
)
_NUMBERS = count()
_FORWARDER = Path(__file__).with_name("path_forwarder.py")


@dataclass(frozen=True, slots=True)
class KernelPath:
    """Rate of IP packets, round trip, and the numbers of the packets with data that are lost."""

    rate_bps: int
    rtt_ms: float
    lost: tuple[int, ...] = ()


@contextmanager
def lossy_connection(path: KernelPath) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Gives both ends of a TCP connection with CUBIC; what the first sends takes the path."""
    number = os.getpid() * 64 + next(_NUMBERS)
    namespace = f"cpnet-p{number}"
    host, agent = (f"198.18.{number >> 7 & 255}.{number << 1 & 254 | n}" for n in (0, 1))
    devices = [f"cq{number:x}{end}" for end in "ha"]
    files = [_tun(device) for device in devices]
    call("ip", "netns", "add", namespace)
    forwarder: subprocess.Popen[bytes] | None = None
    try:
        call("ip", "link", "set", devices[1], "netns", namespace)
        for device, own, peer, inside in (
            (devices[0], host, agent, []),
            (devices[1], agent, host, ["-netns", namespace]),
        ):
            call("ip", *inside, "address", "add", own, "peer", peer, "dev", device)
            call("ip", *inside, "link", "set", device, "mtu", str(MTU), "txqueuelen", "20000", "up")
        command = [sys.executable, str(_FORWARDER), *map(str, files), dumps(asdict(path))]
        forwarder = subprocess.Popen(command, pass_fds=files)
        with connection_from(namespace, host, _SENDER) as connection:
            yield connection
    finally:
        if forwarder is not None:
            forwarder.kill()
            forwarder.wait()
        for file in files:
            os.close(file)
        with suppress(KernelError):
            call("ip", "netns", "delete", namespace)


def _tun(name: str) -> int:
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    try:
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN_NO_PI))
    except OSError:
        os.close(file)
        raise
    return file
