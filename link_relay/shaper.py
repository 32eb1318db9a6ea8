"""A TCP relay whose connections behave like links.

Towards the edge: bytes leave at the path's rate, one after the other, and travel for half a round
trip. No more is read than has left, the receive buffer is small, so that TCP holds the sender back
and what waits, waits with the sender. Towards the agent: half a round trip at any rate, for what
goes there is small.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time

from link_relay.server import Address, Draw, Server, buffer_bytes, make_prompt
from sensing.link.path import SEGMENT_BYTES, Path

CHUNK_NS = 2_000_000  # of the link's time in a chunk, but a packet at least
MOST_BYTES = 65_536
BUFFER_NS = 20_000_000  # what the receive buffer may hide from the sender, in the link's time
LINE_CHUNKS = 1024  # on their way: bounds memory
SLACK_NS = 5_000_000  # a timer that fires late does not slow the link
_log = logging.getLogger(__name__)


class Shaper(Server):
    """Relays every connection over a path of its own; `draw` gives it by the connection's number.

    Runs on a loop of its own with a timer finer than a millisecond.
    """

    def __init__(self, listen: Address, upstream: Address, draw: Draw) -> None:
        """Opens the listening socket.

        Raises:
            OSError: the address is in use.
        """
        super().__init__(listen, buffer_bytes(draw(0), BUFFER_NS))
        self._upstream = upstream
        self._draw = draw
        self._since_ns = time.monotonic_ns()

    async def relay(self, agent: socket.socket, number: int) -> None:
        """Passes on what comes, as the path of this number does."""
        path = self._draw(number)
        edge: socket.socket | None = None
        ways: list[asyncio.Task[None]] = []
        try:
            edge = await self.connect(self._upstream)
            make_prompt(agent, edge)
            ways = [
                self._loop.create_task(self._pass_on(agent, edge, path, limited=True)),
                self._loop.create_task(self._pass_on(edge, agent, path, limited=False)),
            ]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        except OSError as error:
            _log.warning("connection to %s:%d: %s", *self._upstream, error)
        finally:
            for way in ways:
                way.cancel()
            try:  # the end of the relay may come while this one ends
                await asyncio.gather(*ways, return_exceptions=True)
            finally:
                agent.close()
                if edge is not None:
                    edge.close()

    async def _pass_on(
        self, source: socket.socket, sink: socket.socket, path: Path, *, limited: bool
    ) -> None:
        line: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue(LINE_CHUNKS)
        delivery = self._loop.create_task(self._deliver(line, sink))
        try:
            await self._read(source, line, path, limited=limited)
            await line.join()
        finally:
            delivery.cancel()

    async def _read(
        self,
        source: socket.socket,
        line: asyncio.Queue[tuple[int, bytes]],
        path: Path,
        *,
        limited: bool,
    ) -> None:
        free_ns = arrival_ns = self._now_ns()
        while True:
            size = path.bytes_in(self._now_ns(), CHUNK_NS) if limited else MOST_BYTES
            data, waited = await self._receive(source, min(max(size, SEGMENT_BYTES), MOST_BYTES))
            if not data:
                return
            now_ns = self._now_ns()
            # What was here already goes on from where the last chunk ended: the link was not idle.
            start_ns = max(free_ns, now_ns if waited else now_ns - SLACK_NS)
            free_ns = path.departure_ns(start_ns, len(data)) if limited else now_ns
            arrival_ns = max(arrival_ns, free_ns + path.delay_ns(free_ns))
            await line.put((arrival_ns, data))
            if limited:
                await self._sleep_until(free_ns)

    async def _receive(self, source: socket.socket, size: int) -> tuple[bytes, bool]:
        """Returns what came, and whether it had to be waited for."""
        try:
            return source.recv(size), False
        except BlockingIOError:
            return await self._loop.sock_recv(source, size), True
        except OSError:
            return b"", False

    async def _deliver(self, line: asyncio.Queue[tuple[int, bytes]], sink: socket.socket) -> None:
        while True:
            arrival_ns, data = await line.get()
            await self._sleep_until(arrival_ns)
            try:
                await self._loop.sock_sendall(sink, data)
            finally:
                line.task_done()

    async def _sleep_until(self, time_ns: int) -> None:
        await asyncio.sleep(max(0, time_ns - self._now_ns()) / 1e9)

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._since_ns
