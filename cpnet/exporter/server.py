"""Where the page of metrics is, and who serves it."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from cpnet.exporter.tally import Tally
from protocol.errors import ConfigError

_PLACE = re.compile(r"(?:(?P<host>\[[^\]\s]+\]|[^:\[\]/\s]+):)?(?P<port>\d{1,5})")


@dataclass(frozen=True, slots=True)
class Place:
    """An address of this machine."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    @classmethod
    def parse(cls, text: str) -> Place:
        """Reads `PORT`, which means this machine alone, or `HOST:PORT`.

        Raises:
            ConfigError: it is neither, or nobody can listen there.
        """
        match = _PLACE.fullmatch(text)
        if match is None or not 1 <= int(match["port"]) <= 65535:
            raise ConfigError(
                f"--metrics {text!r}: needs PORT or HOST:PORT, with a port from 1 to 65535"
            )
        place = cls((match["host"] or "127.0.0.1").strip("[]"), int(match["port"]))
        place.check_free()
        return place

    def check_free(self) -> None:
        """Raises ConfigError if nobody can listen here."""
        try:
            found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
            with socket.socket(found[0][0]) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(found[0][4])
        except (OSError, UnicodeError) as error:
            raise self._taken(error) from None

    def _taken(self, error: OSError | UnicodeError) -> ConfigError:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        return ConfigError(f"--metrics: cannot listen at {self}: {why}; choose another port")


@contextmanager
def serving(place: Place | None) -> Iterator[Tally | None]:
    """Gives a tally that whoever asks at the place can see; None if there is no place.

    Raises:
        ConfigError: somebody took the place meanwhile.
    """
    if place is None:
        yield None
        return
    # Few runs need it, and each start of the command would wait for it.
    from prometheus_client import CollectorRegistry

    from cpnet.exporter.families import TallyCollector
    from cpnet.exporter.pages import serving_pages

    tally, registry = Tally(), CollectorRegistry()
    registry.register(TallyCollector(tally))
    with ExitStack() as stack:
        try:
            stack.enter_context(serving_pages(place.host, place.port, registry))
        except OSError as error:
            raise place._taken(error) from None
        yield tally
