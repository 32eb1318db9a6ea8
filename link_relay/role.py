"""The relay role: agents of this machine reach the edge through it."""

from __future__ import annotations

import logging
import threading

from link_relay.netns import probe
from link_relay.netns.forwarder import Forwarder
from link_relay.server import Address, Draw, Server
from link_relay.shaper import Shaper
from protocol.bus import Endpoint
from protocol.errors import BusError, ConfigError
from protocol.inbox import Envelope, Presence
from protocol.messages import End
from protocol.process import Context
from sensing.link.config import LinkConfig
from sensing.link.path import Path
from sensing.link.profile import LinkProfile

_log = logging.getLogger(__name__)


class RelayRole:
    """Serves the connections of one kind of agent, the last word of the process's id.

    A connection does not say whose it is: paths are drawn by the order in which agents connect.
    """

    def __init__(self, context: Context, server: Server) -> None:
        self._context = context
        self._server = server
        self._thread = threading.Thread(target=server.run, name="relay")
        self._thread.start()

    @classmethod
    def build(cls, context: Context) -> RelayRole:
        """Listens for agents and shows itself.

        Raises:
            ConfigError: the scenario has no link for these agents, or this machine no namespaces.
            BusError: the port is in use.
        """
        kind = context.id.rpartition("-")[2]
        config = LinkConfig.of(context.setup.scenario)
        profile = _profile(config, kind)
        seed: int = context.setup.scenario["seed"]
        listen, upstream = _address(context.uplink), _address(context.v2x_endpoint)

        def draw(number: int) -> Path:
            return Path.draw(profile, seed, f"{kind} {number}")

        try:
            server = _server(config, listen, upstream, draw)
        except OSError as error:
            raise BusError(f"cannot listen at {context.uplink}: {error.strerror}") from None
        role = cls(context, server)
        context.world.subscribe("end")
        context.announce("relay")
        _log.info("%s links like %s: %s to %s", kind, profile.name, context.uplink, upstream)
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Takes the end of the world."""
        if isinstance(item, Envelope) and isinstance(item.message, End):
            self._context.stop.set()

    def poll(self) -> None:
        """The work is done in the relay's own thread; without it the process is of no use.

        Raises:
            BusError: the relay has failed.
        """
        if not self._thread.is_alive():
            raise BusError("the relay has failed; the reason is above")

    def close(self) -> None:
        """Ends all connections."""
        self._server.stop()
        self._thread.join()


def _server(config: LinkConfig, listen: Address, upstream: Address, draw: Draw) -> Server:
    if config.apply == "netns":
        return Forwarder(listen, upstream, draw, delays=probe.require())
    return Shaper(listen, upstream, draw)


def _profile(config: LinkConfig, kind: str) -> LinkProfile:
    profile = config.profile if kind == "vehicle" else config.roadside_profile
    if profile is None:
        raise ConfigError(f"the scenario has no link profile for {kind} agents")
    return profile


def _address(endpoint: Endpoint) -> Address:
    host, _, port = endpoint.locator.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)
