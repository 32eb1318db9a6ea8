"""A TCP relay that does not shape: every connection goes through a namespace of its own.

    agent → relay, in the agent's namespace → veth, shaped by the kernel → relay, on the host → edge

The edge may be anywhere: no address of it has to be reached from a namespace.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time

from link_relay.netns.iproute import NetnsError
from link_relay.netns.leftovers import remove_of
from link_relay.netns.namespace import Namespace
from link_relay.netns.place import Place
from link_relay.netns.schedule import STEP_NS
from link_relay.server import Address, Draw, Server, buffer_bytes, make_prompt
from sensing.link.path import Path

BUFFER_NS = 10_000_000  # what each buffer before the link may hide, in the link's time
MOST_BYTES = 65_536
FIRST = 1  # number of the first agent's namespace; 0 is the probe's
_log = logging.getLogger(__name__)


class Forwarder(Server):
    """Gives every connection a namespace; `draw` gives its path by the connection's number."""

    def __init__(self, listen: Address, upstream: Address, draw: Draw, *, delays: bool) -> None:
        """Opens the listening socket; `delays` says that the kernel has netem.

        Raises:
            OSError: the address is in use.
        """
        super().__init__(listen, buffer_bytes(draw(0), BUFFER_NS))
        self._upstream = upstream
        self._draw = draw
        self._delays = delays
        self._since_ns = time.monotonic_ns()

    def run(self) -> None:
        """See `Server.run`; what it made is gone afterwards."""
        try:
            super().run()
        finally:
            remove_of(os.getpid())

    async def relay(self, agent: socket.socket, number: int) -> None:
        """Passes on what comes; a kernel that refuses a namespace ends the whole relay."""
        try:
            with agent:
                await self._pass_through(agent, number)
        except* NetnsError as errors:
            _log.error("%s", errors.exceptions[0])
            self.stop()
        except* OSError as errors:
            _log.warning("connection over %s:%d: %s", *self._upstream, errors.exceptions[0])

    async def _pass_through(self, agent: socket.socket, number: int) -> None:
        path = self._draw(number)
        place = Place(os.getpid(), number + FIRST)
        namespace = await asyncio.to_thread(
            Namespace, place, path, self._step(), delays=self._delays
        )
        try:
            inner, outer = await asyncio.to_thread(namespace.connect, self._buffer_bytes(path))
            with inner, outer, await self.connect(self._upstream) as edge:
                make_prompt(agent, inner, outer, edge)
                await self._exchange(namespace, ((agent, inner), (outer, edge)))
        finally:
            await asyncio.shield(asyncio.to_thread(namespace.remove))

    async def _exchange(
        self, namespace: Namespace, links: tuple[tuple[socket.socket, socket.socket], ...]
    ) -> None:
        """Copies both ways before and behind the shaped link, until all have come to their end."""
        async with asyncio.TaskGroup() as group:
            following = group.create_task(self._follow(namespace))
            ways = [way for a, b in links for way in ((a, b), (b, a))]
            await asyncio.wait([group.create_task(self._copy(*way)) for way in ways])
            following.cancel()

    async def _copy(self, source: socket.socket, sink: socket.socket) -> None:
        while data := await self._loop.sock_recv(source, MOST_BYTES):
            await self._loop.sock_sendall(sink, data)
        sink.shutdown(socket.SHUT_WR)

    async def _follow(self, namespace: Namespace) -> None:
        while True:
            next_ns = (self._step() + 1) * STEP_NS
            await asyncio.sleep((next_ns - self._now_ns()) / 1e9)
            namespace.follow(self._step())

    def _buffer_bytes(self, path: Path) -> int:
        """What is on its way stays in the sender's buffer until the other side has told of it."""
        period_ns = path.rtt_ns.period_ns
        round_trip_ns = path.rtt_ns.integral(0, period_ns) // period_ns if self._delays else 0
        return buffer_bytes(path, BUFFER_NS + round_trip_ns)

    def _step(self) -> int:
        return self._now_ns() // STEP_NS

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._since_ns
