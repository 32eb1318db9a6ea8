"""What stands around a relay in its tests: an edge that listens, an agent that is connected."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from link_relay.shaper import Address, Shaper
from protocol.tcpinfo import unsent_bytes
from sensing.link_channel import Channel
from sensing.link_config import profile_named
from sensing.link_profile import LinkProfile
from tests.waiting import TIMEOUT_S, wait_until


class Sink:
    """The far side: keeps the bytes, and when how many were there."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address: Address = self.server.getsockname()
        self.data = bytearray()
        self.marks: list[tuple[int, int]] = []
        self.peer: socket.socket | None = None
        self.accepted = threading.Event()
        self.ended = threading.Event()
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self) -> None:
        self.peer, _ = self.server.accept()
        self.accepted.set()
        with self.peer:
            while data := self.peer.recv(1 << 16):
                self.data += data
                self.marks.append((time.monotonic_ns(), len(self.data)))
        self.ended.set()

    def arrival_ns(self, total_bytes: int) -> int:
        """Waits until so many bytes have come in all; returns when they had."""
        wait_until(
            lambda: self.marks and self.marks[-1][1] >= total_bytes,
            what=f"{total_bytes} bytes did not come",
        )
        return next(when for when, count in list(self.marks) if count >= total_bytes)


class Rig:
    """A relay before a sink, and one connection to it."""

    def __init__(self, profile: str, seed: int = 1) -> None:
        self.path = Channel.draw(profile_named(profile) or LinkProfile(), seed, "vehicle 0")
        self.sink = Sink()
        self.since_ns = time.monotonic_ns()
        self.relay = Shaper(("127.0.0.1", 0), self.sink.address, lambda _: self.path)
        self.thread = threading.Thread(target=self.relay.run)
        self.thread.start()
        self.agent = socket.create_connection(self.relay.address)
        self.agent.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.agent.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        assert self.sink.accepted.wait(TIMEOUT_S)

    def unsent_bytes(self) -> int:
        """What of the agent's bytes the relay has not taken."""
        host, port = self.agent.getsockname()
        return unsent_bytes(f"tcp/{host}:{port}")

    def close(self) -> None:
        self.agent.close()
        self.relay.stop()
        self.thread.join(TIMEOUT_S)
        assert not self.thread.is_alive()
        assert self.sink.ended.wait(TIMEOUT_S)
        self.sink.server.close()


@contextmanager
def rigs() -> Iterator[Callable[[str], Rig]]:
    """Gives a maker of rigs by their links' profile, and closes what it made."""
    made: list[Rig] = []

    def make(profile: str) -> Rig:
        made.append(Rig(profile))
        return made[-1]

    yield make
    for rig in made:
        rig.close()
