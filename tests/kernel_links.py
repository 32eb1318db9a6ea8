"""Network namespaces and links that the kernel shapes (`ip`, `tc`), for tests that run as root."""

from __future__ import annotations

import ctypes
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

from protocol.traffic import HEADER_BYTES, SEGMENT_BYTES
from tests.waiting import TIMEOUT_S

MTU = SEGMENT_BYTES + HEADER_BYTES
FRAME_BYTES = MTU + 14  # tbf counts the header of Ethernet, a profile's rate does not
_CLONE_NEWNET = 0x40000000
_RANGE = "198.19"  # RFC 2544's range for tests


class KernelError(Exception):
    """The kernel, `ip` or `tc` refused something; the text is theirs."""


def call(program: str, *words: str, lines: Sequence[str] = ()) -> None:
    """Runs `ip` or `tc` to its end, with lines for `-batch -` if there are any."""
    command = [program, *words, *(["-batch", "-"] if lines else [])]
    text = "".join(f"{line}\n" for line in lines)
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise KernelError(f"{' '.join(command)}: {' '.join(done.stderr.split())}")


def missing() -> str:
    """Returns what this machine lacks for such tests, found out by making a link; empty if none."""
    absent = [program for program in ("ip", "tc") if shutil.which(program) is None]
    if absent:
        return f"the program {absent[0]} (Debian package iproute2)"
    try:
        with shaped_connection(10_000_000):
            return ""
    except (KernelError, OSError) as error:
        return f"root, veth or sch_tbf: {error}"


@contextmanager
def shaped_connection(rate_bps: int) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Gives both ends of a TCP connection; what the first sends passes at a rate of IP packets."""
    namespace, device = f"cpnet-{os.getpid()}", f"cp{os.getpid()}"
    host, agent = (
        f"{_RANGE}.{os.getpid() >> 7 & 255}.{os.getpid() << 1 & 254 | n}" for n in (0, 1)
    )
    kept_bps = rate_bps * FRAME_BYTES // MTU
    shaped = f"qdisc add dev uplink root tbf rate {kept_bps}bit burst {2 * FRAME_BYTES} limit 4mb"
    ends = f"link add {device} mtu {MTU} type veth peer name uplink mtu {MTU} netns {namespace}"
    call("ip", "netns", "add", namespace)
    try:
        call("ip", lines=[ends, f"address add {host}/31 dev {device}", f"link set {device} up"])
        inside = [f"address add {agent}/31 dev uplink", "link set uplink up", "link set lo up"]
        call("ip", "-netns", namespace, lines=inside)
        call("tc", "-netns", namespace, *shaped.split())
        with connection_from(namespace, host) as connection:
            yield connection
    finally:
        with suppress(KernelError):
            call("ip", "link", "delete", device)
        call("ip", "netns", "delete", namespace)


@contextmanager
def connection_from(
    namespace: str, host: str, options: Sequence[tuple[int, int, int | bytes]] = ()
) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Gives both ends of a TCP connection from a network namespace to an address outside it.

    Args:
        namespace: where the sender is.
        host: the address that the receiver listens on.
        options: of the sender's socket, set before it connects.
    """
    # A socket belongs to the namespace of the thread that made it: here one that then ends.
    with (
        ThreadPoolExecutor(1) as thread,
        socket.create_server((host, 0)) as server,
        thread.submit(_socket_in, namespace).result() as sender,
    ):
        for option in options:
            sender.setsockopt(*option)
        server.settimeout(10)
        sender.settimeout(10)
        sender.connect(server.getsockname())
        receiver, _ = server.accept()
        with receiver:
            for end in (sender, receiver):
                end.settimeout(TIMEOUT_S)  # a path that is gone tells neither end
            yield sender, receiver


def receive_whole(receiver: socket.socket, size_bytes: int) -> None:
    """Waits until a message of this size has come whole.

    Raises:
        OSError: it cannot come any more, or did not for long.
    """
    left_bytes = size_bytes
    while left_bytes:
        came_bytes = len(receiver.recv(left_bytes))
        if not came_bytes:
            raise ConnectionError(f"{left_bytes} of {size_bytes} bytes did not come")
        left_bytes -= came_bytes


def _socket_in(namespace: str) -> socket.socket:
    """Returns a TCP socket of a network namespace."""
    entry = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    try:
        if ctypes.CDLL(None, use_errno=True).setns(entry, _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return socket.socket()
    finally:
        os.close(entry)
