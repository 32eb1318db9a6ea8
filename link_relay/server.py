"""What relays have in common: they accept agents' connections and serve each on a loop."""

from __future__ import annotations

import asyncio
import selectors
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable

from sensing.link.path import SEGMENT_BYTES, Path

LEAST_BUFFER_BYTES = 4096
MOST_BUFFER_BYTES = 1 << 20

Address = tuple[str, int]
Draw = Callable[[int], Path]


class Server(ABC):
    """Serves every connection in a task of its own; on a loop with a timer finer than a ms."""

    def __init__(self, listen: Address, buffer_bytes: int) -> None:
        """Opens the listening socket; `buffer_bytes` is what may wait unread on a connection.

        Raises:
            OSError: the address is in use.
        """
        self._listener = _listener(listen, buffer_bytes)
        self._loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
        self._accepting = self._loop.create_task(self._accept())
        self._tasks: set[asyncio.Task[None]] = set()
        self.connections = 0

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self._listener.getsockname()[:2]
        return host, port

    def run(self) -> None:
        """Relays until `stop`; for a thread of its own."""
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._accepting)
        except asyncio.CancelledError:
            pass
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._listener.close()
            self._loop.close()

    def stop(self) -> None:
        """Ends `run` and all connections; may be called from any thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._accepting.cancel)

    @abstractmethod
    async def relay(self, agent: socket.socket, number: int) -> None:
        """Serves the connection of this number, and closes it."""

    async def _accept(self) -> None:
        try:
            while True:
                agent, _ = await self._loop.sock_accept(self._listener)
                task = self._loop.create_task(self.relay(agent, self.connections))
                self.connections += 1
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    async def connect(self, upstream: Address) -> socket.socket:
        """Returns a connection to the edge.

        Raises:
            OSError: it is not there.
        """
        family = socket.AF_INET6 if ":" in upstream[0] else socket.AF_INET
        edge = socket.socket(family, socket.SOCK_STREAM)
        try:
            edge.setblocking(False)
            await self._loop.sock_connect(edge, upstream)
        except BaseException:
            edge.close()
            raise
        return edge


def make_prompt(*ends: socket.socket) -> None:
    """Sets sockets up for a loop: nothing blocks, nothing waits for more to send."""
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def buffer_bytes(path: Path, span_ns: int) -> int:
    """Returns what a path takes in a span on the average, within what a buffer can be."""
    period_ns = path.rate_bps.period_ns
    mean = path.bytes_in(0, period_ns) * span_ns // period_ns
    return min(max(mean, LEAST_BUFFER_BYTES), MOST_BUFFER_BYTES)


def _listener(address: Address, buffer_bytes: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Accepted connections inherit both. Loopback's segments of 64 kB would not fit the buffer.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT_BYTES)
        listener.bind(address)
        listener.listen(128)
        listener.setblocking(False)
    except OSError:
        listener.close()
        raise
    return listener
