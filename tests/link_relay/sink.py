"""The far side of a relay."""

import socket
import threading
import time


class Sink:
    """The far side: notes when each message of a fixed size is whole, or keeps the bytes."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address: tuple[str, int] = self.server.getsockname()
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

    def arrival_ns(self, total_bytes: int, patience_s: float = 20) -> int:
        give_up_ns = time.monotonic_ns() + int(patience_s * 1e9)
        while len(self.data) < total_bytes:
            assert time.monotonic_ns() < give_up_ns, f"{len(self.data)} of {total_bytes} came"
            time.sleep(0.002)
        return next(when for when, count in list(self.marks) if count >= total_bytes)
