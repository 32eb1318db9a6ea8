"""One agent's network namespace: a veth pair to the host, its uplink shaped by the kernel."""

from __future__ import annotations

import socket

from link_relay.netns import qdisc, schedule
from link_relay.netns.enter import socket_in
from link_relay.netns.iproute import PATIENCE_S, Batch, NetnsError, call
from link_relay.netns.leftovers import remove
from link_relay.netns.place import UPLINK, Pair, Place
from sensing.link.path import Path

LOOPBACK = "lo"  # has one queue: asked for it, `tc` answers in one line
_DISCARD_PORT = 9


class Namespace:
    """Follows a path in the steps of `schedule`; without netem (`delays`) its rate alone."""

    def __init__(self, place: Place, path: Path, step: int, *, delays: bool) -> None:
        """Makes the namespace with the link as it is in a step.

        Raises:
            NetnsError: it cannot be made; nothing of it is left.
        """
        self._place = place
        self._path = path
        self._batches: list[Batch] = []
        self._nudge: socket.socket | None = None
        try:
            self._addresses = _make(place)
            self._nudge = socket_in(place.namespace, socket.SOCK_DGRAM)
            self._tc = self._batch("-netns", place.namespace)
            self._host_tc = self._batch() if delays else None
            self._rate_bps, self._delay_us = -1, -1
            self._shape("add", step)
        except (NetnsError, OSError):
            self.remove()
            raise

    def follow(self, step: int) -> None:
        """Makes the link what it is in a step.

        Raises:
            NetnsError: `tc` failed.
        """
        self._shape("change", step)

    def connect(self, buffer_bytes: int) -> tuple[socket.socket, socket.socket]:
        """Returns both ends of a connection over the link, the agent's first.

        Raises:
            NetnsError: the packets do not pass.
        """
        inner = socket_in(self._place.namespace, socket.SOCK_STREAM)
        inner.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer_bytes)
        try:
            with socket.create_server((self._addresses.host, 0)) as server:
                server.settimeout(PATIENCE_S)
                inner.settimeout(PATIENCE_S)
                inner.connect(server.getsockname())
                outer, _ = server.accept()
        except OSError as error:
            inner.close()
            raise NetnsError(
                f"{self._addresses.agent} in {self._place.namespace} cannot reach "
                f"{self._addresses.host} on the host ({error}): does a firewall forbid it?"
            ) from None
        return inner, outer

    def remove(self) -> None:
        """Removes the namespace, its devices and its processes; twice is as good as once."""
        for batch in self._batches:
            batch.close()
        self._batches.clear()
        if self._nudge is not None:
            self._nudge.close()
        remove(self._place)

    def _batch(self, *words: str) -> Batch:
        batch = Batch(*words)
        self._batches.append(batch)
        return batch

    def _shape(self, verb: str, step: int) -> None:
        rate_bps = schedule.rate_bps(self._path, step)
        delay_us = schedule.delay_us(self._path, step)
        if rate_bps != self._rate_bps:
            line = qdisc.tbf(verb, rate_bps, schedule.held_ns(self._path, step))
            self._tc.tell(line, LOOPBACK)
            if rate_bps > self._rate_bps:
                self._wake()
        if self._host_tc is not None and delay_us != self._delay_us:
            device = self._place.device
            self._tc.tell(qdisc.delay_of_agent(verb, delay_us), LOOPBACK)
            self._host_tc.tell(qdisc.delay_of_host(verb, device, delay_us), device)
        self._rate_bps, self._delay_us = rate_bps, delay_us

    def _wake(self) -> None:
        """Sends an empty packet: until one comes, tbf sleeps as long as the old rate bade it."""
        if self._nudge is not None:
            self._nudge.sendto(b"", (self._addresses.host, _DISCARD_PORT))


def _make(place: Place) -> Pair:
    call("ip", "netns", "add", place.namespace)
    ends = f"{place.device} mtu {qdisc.MTU} type veth peer name {UPLINK} mtu {qdisc.MTU}"
    call("ip", "link", "add", *f"{ends} netns {place.namespace}".split())
    addresses = Pair.of(socket.if_nametoindex(place.device))
    call("ip", lines=_up(place.device, addresses.host))
    inside = [f"link set {LOOPBACK} up", *_up(UPLINK, addresses.agent)]
    call("ip", "-netns", place.namespace, lines=inside)
    return addresses


def _up(device: str, address: str) -> list[str]:
    return [f"address add {address}/31 dev {device}", f"link set {device} up"]
