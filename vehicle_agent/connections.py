"""The V2X connections of a process's CAVs, one each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from protocol.bus import Bus


class Connections:
    """Opens a connection when an agent first asks.

    Over a mobile network that takes several round trips: with `wait` false it is done in the
    background, so that a newcomer does not hold up the other agents of its process.
    """

    def __init__(self, open_v2x: Callable[[], Bus], *, wait: bool) -> None:
        self._open_v2x = open_v2x
        self._wait = wait
        self._buses: dict[str, Future[Bus]] = {}
        self._workers = ThreadPoolExecutor(4, "connect")

    def get(self, agent: str) -> Bus | None:
        """Returns the agent's connection, None while it is being opened.

        Raises:
            BusError: nothing answers.
        """
        if agent not in self._buses:
            self._buses[agent] = self._workers.submit(self._open_v2x)
        opening = self._buses[agent]
        return opening.result() if self._wait or opening.done() else None

    def close_all_but(self, agents: Iterable[str]) -> None:
        """Hangs up the connections of all agents that are not named."""
        for agent in sorted(self._buses.keys() - set(agents)):
            self._buses.pop(agent).add_done_callback(_close)

    def close(self) -> None:
        """Hangs up all; those still being opened as soon as they are."""
        self.close_all_but(())
        self._workers.shutdown()


def _close(opened: Future[Bus]) -> None:
    if opened.exception() is None:
        opened.result().close()
