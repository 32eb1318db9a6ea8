"""A TCP relay that shapes connections like links: rate, delay and packet loss.

Towards the edge: bytes leave at the channel's rate, one after the other, and travel for half a
round trip. No more is read than has left and the receive buffer is small, so that TCP holds the
sender back and the queue stays with the sender. Where packets are lost, the window of a computed
TCP decides what is read and when it arrives (`sensing.tcp_sender`). Towards the agent: half a round
trip at any rate, because messages to agents are small.
"""

from __future__ import annotations

import asyncio
import logging
import selectors
import socket
import time
from collections.abc import Callable

from protocol.traffic import SEGMENT_BYTES
from sensing.link_channel import Channel
from sensing.tcp_sender import TcpSender

CHUNK_NS = 2_000_000  # of the link's time in a chunk, but a packet at least
MOST_BYTES = 65_536
BUFFER_NS = 20_000_000  # what the receive buffer may hide from the sender, in the link's time
LEAST_BUFFER_BYTES = 4096
MOST_BUFFER_BYTES = 1 << 20
LINE_CHUNKS = 1024  # in transit: bounds memory
PART_NS = 500_000  # that a part of a packet waits for its rest
SLACK_NS = 5_000_000  # a timer that fires late does not slow the link
_log = logging.getLogger(__name__)

Address = tuple[str, int]
Draw = Callable[[int], Channel]


class Shaper:
    """Relays every connection over a channel of its own; `draw` gives it by the number.

    A task a connection, on a loop whose timer is finer than a millisecond.
    """

    def __init__(self, listen: Address, upstream: Address, draw: Draw) -> None:
        """Opens the listening socket.

        Raises:
            OSError: the address is in use.
        """
        self._listener = _listener(listen, _buffer_bytes(draw(0)))
        self._loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
        self._accepting = self._loop.create_task(self._accept())
        self._tasks: set[asyncio.Task[None]] = set()
        self._connections = 0
        self._upstream = upstream
        self._draw = draw
        self._since_ns = time.monotonic_ns()

    @property
    def address(self) -> Address:
        """The address it listens at."""
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
            self._listener.close()
            self._loop.close()

    def stop(self) -> None:
        """Ends `run` and all connections; may be called from any thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._accepting.cancel)

    async def _accept(self) -> None:
        try:
            while True:
                agent, _ = await self._loop.sock_accept(self._listener)
                task = self._loop.create_task(self._relay(agent, self._connections))
                self._connections += 1
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _relay(self, agent: socket.socket, number: int) -> None:
        """Relays the connection of this number in both directions, and closes it."""
        channel = self._draw(number)
        edge: socket.socket | None = None
        directions: list[asyncio.Task[None]] = []
        try:
            edge = await self._connect()
            for end in (agent, edge):
                end.setblocking(False)
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            directions = [
                self._loop.create_task(self._pass_on(agent, edge, channel, limited=True)),
                self._loop.create_task(self._pass_on(edge, agent, channel, limited=False)),
            ]
            await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
        except OSError as error:
            _log.warning("connection to %s:%d: %s", *self._upstream, error)
        finally:
            for direction in directions:
                direction.cancel()
            try:  # the end of the relay may come while this one ends
                await asyncio.gather(*directions, return_exceptions=True)
            finally:
                agent.close()
                if edge is not None:
                    edge.close()

    async def _connect(self) -> socket.socket:
        edge = socket.socket(_family(self._upstream), socket.SOCK_STREAM)
        try:
            edge.setblocking(False)
            await self._loop.sock_connect(edge, self._upstream)
        except BaseException:
            edge.close()
            raise
        return edge

    async def _pass_on(
        self, source: socket.socket, sink: socket.socket, channel: Channel, *, limited: bool
    ) -> None:
        line: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue(LINE_CHUNKS)
        delivery = self._loop.create_task(self._deliver(line, sink))
        try:
            if limited and channel.losses is not None:
                await self._read_lossy(source, line, TcpSender(channel, channel.losses))
            else:
                await self._read(source, line, channel, limited=limited)
            await line.join()
        finally:
            delivery.cancel()

    async def _read(
        self,
        source: socket.socket,
        line: asyncio.Queue[tuple[int, bytes]],
        channel: Channel,
        *,
        limited: bool,
    ) -> None:
        free_ns = arrival_ns = self._now_ns()
        while True:
            size = channel.bytes_in(self._now_ns(), CHUNK_NS) if limited else MOST_BYTES
            data, waited = await self._receive(source, min(max(size, SEGMENT_BYTES), MOST_BYTES))
            if not data:
                return
            now_ns = self._now_ns()
            # What was here already goes on from where the last chunk ended: the link was not idle.
            start_ns = max(free_ns, now_ns if waited else now_ns - SLACK_NS)
            free_ns = channel.departure_ns(start_ns, len(data)) if limited else now_ns
            arrival_ns = max(arrival_ns, free_ns + channel.delay_ns(free_ns))
            await line.put((arrival_ns, data))
            if limited:
                await self._sleep_until(free_ns)

    async def _read_lossy(
        self, source: socket.socket, line: asyncio.Queue[tuple[int, bytes]], sender: TcpSender
    ) -> None:
        """Reads what the window of a TCP over the channel takes; delivers what has arrived.

        A read ends anywhere in a packet: a part waits for its rest while full ones leave.
        """
        read, undelivered, delivered_bytes, written_ns = bytearray(), bytearray(), 0, 0
        receiving: asyncio.Task[tuple[bytes, bool]] | None = None
        is_open = True
        try:
            while is_open or read or not sender.is_done:
                sender.advance(self._now_ns())
                for one in sender.delivered:
                    size = one.end_byte - delivered_bytes
                    await line.put((one.arrival_ns, bytes(undelivered[:size])))
                    del undelivered[:size]
                    delivered_bytes = one.end_byte
                sender.delivered.clear()
                sender.transmitted.clear()
                if is_open and receiving is None and sender.room:
                    size = min(sender.room * SEGMENT_BYTES, MOST_BYTES)
                    receiving = self._loop.create_task(self._receive(source, size))
                await self._wait(
                    receiving, _earlier(sender, written_ns + PART_NS if read else None)
                )
                size = len(read) if self._now_ns() >= written_ns + PART_NS else 0
                if receiving is not None and receiving.done():
                    data, _ = receiving.result()
                    receiving, is_open = None, bool(data)
                    read += data
                    is_part = len(data) >= SEGMENT_BYTES
                    size = len(read) - (len(read) % SEGMENT_BYTES if is_part else 0)
                if size:
                    written_ns = self._now_ns()
                    sender.advance(written_ns)
                    sender.write(size)
                    undelivered += read[:size]
                    del read[:size]
        finally:
            if receiving is not None:
                receiving.cancel()

    async def _wait(
        self, receiving: asyncio.Task[tuple[bytes, bool]] | None, until_ns: int | None
    ) -> None:
        """Waits for data or for a time, whichever comes first."""
        if receiving is None:
            await self._sleep_until(until_ns or 0)
            return
        timeout_s = None if until_ns is None else max(0, until_ns - self._now_ns()) / 1e9
        await asyncio.wait({receiving}, timeout=timeout_s)

    async def _receive(self, source: socket.socket, size: int) -> tuple[bytes, bool]:
        """Returns the received bytes, and whether it had to wait for them."""
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


def _earlier(sender: TcpSender, time_ns: int | None) -> int | None:
    """Returns when the sender's next event is, or a time before it."""
    return min((t for t in (sender.next_event_ns(), time_ns) if t is not None), default=None)


def _buffer_bytes(channel: Channel) -> int:
    """Returns what a channel takes in `BUFFER_NS` on average, within the limits of a buffer."""
    period_ns = channel.rate_bps.period_ns
    mean = channel.bytes_in(0, period_ns) * BUFFER_NS // period_ns
    return min(max(mean, LEAST_BUFFER_BYTES), MOST_BUFFER_BYTES)


def _family(address: Address) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


def _listener(address: Address, buffer_bytes: int) -> socket.socket:
    listener = socket.socket(_family(address), socket.SOCK_STREAM)
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
