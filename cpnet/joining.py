"""Joining a run whose world is elsewhere: waits for it, hears its setup, looks for twins."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console

from protocol.bus import Endpoint, ZenohBus, open_bus, unanswered
from protocol.errors import BusError, ConfigError
from protocol.inbox import Inbox
from protocol.messages import Setup
from protocol.topics import BusName
from protocol.version import PresentProcesses

PATIENCE_S = 60.0
TELL_S = 1.0
FIRST_OPEN_MS, LONGEST_OPEN_MS = 400, 3_200  # nothing else, no signal either, is dealt with then
ASK_S = 2.0
ROLL_CALL_S = 0.5
POLL_S = 0.1
LOST_S = 25.0  # the token of a machine that was lost stands for the lease of 20 s


class Patience:
    """How long the other side is waited for; said once, and without an end if `endless`."""

    def __init__(self, what: str, console: Console, *, endless: bool) -> None:
        self._what = what
        self._console = console
        self._endless = endless
        self._began_s = time.monotonic()
        self._is_told = self._is_over = False

    def wait(self, why: BusError) -> None:
        """Lets a moment pass.

        Raises:
            BusError: the one that was given; the time is over.
        """
        waited_s = time.monotonic() - self._began_s
        if waited_s >= TELL_S and not self._is_told:
            self._is_told = True
            say(self._console, f"waiting for {self._what} (Ctrl-C ends)")
        if waited_s >= PATIENCE_S and not self._is_over:
            if not self._endless:
                raise why
            self._is_over = True
            say(self._console, f"still waiting: {why}")
        time.sleep(POLL_S)


class World:
    """The world's bus, and what the host of that world says there."""

    def __init__(
        self, bus: ZenohBus, endpoint: Endpoint, console: Console, *, lasting: bool
    ) -> None:
        self._bus = bus
        self._endpoint = endpoint
        self._console = console
        self._lasting = lasting

    def setup(self) -> Setup:
        """Returns what every process of the run is given.

        Raises:
            BusError: nobody said it in time, or they speak another version of the protocol.
            ProtocolError: what was said is no setup.
        """
        what = f"the world: nobody at {_place(self._endpoint)} tells the setup of a run"
        patience = Patience(what, self._console, endless=self._lasting)
        nobody = BusError(f"{self._endpoint.locator} is up, but nobody there serves setup")
        while (setup := self._bus.ask("setup", Setup, ASK_S)) is None:
            self._refuse_strangers()
            patience.wait(nobody)
        return setup

    def refuse_twins(self, ids: Iterable[str]) -> None:
        """Sees to it that nobody on this bus goes by these ids, for two would speak for the same.

        Who is lasting gives what may be left of a machine that was lost the time to vanish.

        Raises:
            ConfigError: somebody does.
        """
        gone_by_s = time.monotonic() + (LOST_S if self._lasting else 0)
        wanted, is_told = set(ids), False
        while twins := sorted(wanted.intersection(self._roll().present)):
            if time.monotonic() >= gone_by_s:
                raise ConfigError(
                    f"{', '.join(twins)} runs on this bus already: stop it, or take another with "
                    "--only"
                )
            if not is_told:
                say(self._console, f"waiting for another {', '.join(twins)} to be gone")
            is_told = True
            time.sleep(POLL_S)

    def _roll(self) -> PresentProcesses:
        return PresentProcesses.of(self._bus.list_present(ROLL_CALL_S))

    def _refuse_strangers(self) -> None:
        """Waits for nobody where all that live speak another version of the protocol."""
        roll = self._roll()
        if roll.other_versions and not roll.present:
            raise BusError(f"{self._endpoint.locator}: {roll.mismatch()}")


def say(console: Console, text: str) -> None:
    """Prints a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def joined(endpoint: Endpoint, console: Console, *, lasting: bool) -> Iterator[World]:
    """Opens the world's bus as soon as it is there.

    Zenoh keeps the main thread while it opens, and signals with it, so it tries for short times;
    they grow, because a slow link takes longer. Who is `lasting` waits without an end.

    Raises:
        BusError: nothing answered in time.
    """
    bus = _opened(endpoint, Patience(_named(endpoint), console, endless=lasting))
    try:
        yield World(bus, endpoint, console, lasting=lasting)
    finally:
        bus.close()


def _opened(endpoint: Endpoint, patience: Patience) -> ZenohBus:
    timeout_ms = FIRST_OPEN_MS
    while True:
        try:
            return open_bus(BusName.WORLD, endpoint, Inbox(), timeout_ms)
        except BusError:
            patience.wait(BusError(unanswered(BusName.WORLD, endpoint, PATIENCE_S)))
        timeout_ms = min(2 * timeout_ms, LONGEST_OPEN_MS)


def _named(endpoint: Endpoint) -> str:
    return f"the world bus at {_place(endpoint)}"


def _place(endpoint: Endpoint) -> str:
    return endpoint.locator.partition("/")[2]
