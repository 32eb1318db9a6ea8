"""The relay role: emulates the links between this machine's agents and the edge."""

from __future__ import annotations

import logging
import threading

from link_relay.shaper import Address, Shaper
from protocol.bus import Endpoint
from protocol.errors import BusError, ConfigError
from protocol.inbox import Envelope, Presence
from protocol.messages import End
from protocol.process import Context
from sensing.link_channel import Channel
from sensing.link_config import LinkConfig
from sensing.link_profile import LinkProfile

_log = logging.getLogger(__name__)


class RelayRole:
    """Serves the connections of one kind of agent, which the process's id ends with.

    A connection does not identify its agent: channels are drawn in the order of connecting.
    """

    def __init__(self, context: Context, shaper: Shaper) -> None:
        self._context = context
        self._shaper = shaper
        self._thread = threading.Thread(target=shaper.run, name="relay")
        self._thread.start()

    @classmethod
    def build(cls, context: Context) -> RelayRole:
        """Listens for agents and announces the role.

        Raises:
            ConfigError: the scenario has no link for these agents.
            BusError: the port is in use.
        """
        kind = context.id.rpartition("-")[2]
        config = LinkConfig.of(context.setup.scenario)
        profile = _profile(config, kind)
        seed: int = context.setup.scenario["seed"]
        listen, upstream = _address(context.uplink), _address(context.v2x_endpoint)

        def draw(number: int) -> Channel:
            return Channel.draw(profile, seed, f"{kind} {number}")

        try:
            shaper = Shaper(listen, upstream, draw)
        except OSError as error:
            raise BusError(f"cannot listen at {context.uplink}: {error.strerror}") from None
        role = cls(context, shaper)
        context.world.subscribe("end")
        context.announce("relay")
        _log.info("%s links like %s: %s to %s", kind, profile.name, context.uplink, upstream)
        return role

    def on(self, item: Envelope | Presence) -> None:
        """Stops at the end of the run."""
        if isinstance(item, Envelope) and isinstance(item.message, End):
            self._context.stop.set()

    def poll(self) -> None:
        """Checks the thread that does the work.

        Raises:
            BusError: the relay has failed.
        """
        if not self._thread.is_alive():
            raise BusError("the relay has failed; the reason is above")

    def close(self) -> None:
        """Ends all connections."""
        self._shaper.stop()
        self._thread.join()


def _profile(config: LinkConfig, kind: str) -> LinkProfile:
    profile = config.profile if kind == "vehicle" else config.roadside_profile
    if profile is None:
        raise ConfigError(f"the scenario has no link profile for {kind} agents")
    return profile


def _address(endpoint: Endpoint) -> Address:
    host, _, port = endpoint.locator.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)
