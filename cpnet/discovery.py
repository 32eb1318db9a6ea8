"""Run discovery: RUN/buses.json holds the endpoints; joining waits for a world elsewhere."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from cpnet.endpoints import Endpoints, connecting, places
from cpnet.run_folder import RUNS, written
from cpnet.security import VIEW, check_key
from protocol.access import Keys
from protocol.bus import Endpoint, ZenohBus, open_bus, unanswered
from protocol.config import is_file, is_folder
from protocol.errors import BusError, ConfigError
from protocol.inbox import Inbox
from protocol.messages import Setup
from protocol.topics import BusName
from protocol.version import PresentProcesses

FILE_NAME = "buses.json"
_ORDER = (BusName.V2X, BusName.WORLD)


@dataclass(frozen=True, slots=True)
class RunLocation:
    """The buses of a running run, and its folder; None if it runs on another machine."""

    v2x: Endpoint
    world: Endpoint
    run_dir: Path | None = None


@contextmanager
def discoverable(run_dir: Path, endpoints: Endpoints, keys: Path | None) -> Iterator[None]:
    """Writes RUN/buses.json for as long as the context lasts.

    Raises:
        ConfigError: it cannot be written.
    """
    path = run_dir / FILE_NAME
    facts = {bus.value: connecting(endpoints[bus]).locator for bus in BusName}
    facts |= {"keys": str(keys.resolve())} if keys is not None else {}
    try:
        with written(run_dir):
            path.write_text(json.dumps({**facts, "pid": os.getpid()}, indent=2) + "\n", "utf-8")
        yield
    finally:
        path.unlink(missing_ok=True)


def find_run(run: Path | None, connect: list[str], keys: Path | None) -> RunLocation:
    """Returns the location of a run: at `connect`, of a folder, or the newest that still runs.

    Raises:
        ConfigError: there is none, or its place or its keys cannot be used.
    """
    if connect:
        if run is not None:
            raise ConfigError(f"{run}: give a run folder or --connect, not both")
        return _elsewhere(connect, keys)
    return _newest(keys) if run is None else _in_folder(run, keys)


def _elsewhere(connect: list[str], keys: Path | None) -> RunLocation:
    found = places("--connect", connect, "tls" if keys else "tcp")
    if missing := [bus.value for bus in BusName if bus not in found]:
        raise ConfigError(f"--connect: where is the {missing[0]} bus? {missing[0]}=HOST:PORT")
    own = _viewer_keys(keys)
    v2x, world = (Endpoint(found[bus], listen=False, keys=own) for bus in _ORDER)
    return RunLocation(v2x, world)


def _newest(keys: Path | None) -> RunLocation:
    for path in sorted(RUNS.glob(f"*/{FILE_NAME}"), key=_age_ns):
        if _is_alive(path):
            return _in_folder(path.parent, keys)
    raise ConfigError(
        f"no run goes on in {RUNS}/: give its folder, or --connect HOST:PORT if it is elsewhere"
    )


def _in_folder(run_dir: Path, keys: Path | None) -> RunLocation:
    path = run_dir / FILE_NAME
    if not is_file(path) or not _is_alive(path):
        raise ConfigError(f"{run_dir}: no run goes on there; {_instead(run_dir)}")
    facts = _facts(path)
    own = _viewer_keys(keys or (Path(facts["keys"]) if "keys" in facts else None))
    try:
        v2x, world = (Endpoint(facts[bus.value], listen=False, keys=own) for bus in _ORDER)
    except KeyError as error:
        raise ConfigError(f"{path} does not say where the bus {error} is") from None
    return RunLocation(v2x, world, run_dir)


def _instead(run_dir: Path) -> str:
    """Returns advice for a folder without a running run."""
    if is_file(run_dir / "run.sqlite"):
        return f"it has ended: `cpnet report {run_dir}` says what came of it"
    if is_folder(run_dir) or is_file(run_dir):
        return "it is no run folder"
    return f"`cpnet up --out {run_dir}` would start one"


def _viewer_keys(keys: Path | None) -> Keys | None:
    if keys is None:
        return None
    check_key(keys, VIEW)
    return Keys.of(keys, VIEW)


def _facts(path: Path) -> dict[str, str]:
    try:
        return {name: str(value) for name, value in json.loads(path.read_text("utf-8")).items()}
    except (OSError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def _is_alive(path: Path) -> bool:
    """Whether the process that wrote it still runs: one that was killed leaves it behind."""
    try:
        pid = int(_facts(path).get("pid", "0"))
        if pid > 0:
            os.kill(pid, 0)
    except (ConfigError, ValueError, OverflowError, ProcessLookupError):
        return False
    except PermissionError:  # it is another user's
        return True
    return pid > 0


def _age_ns(path: Path) -> int:
    try:
        return -path.stat().st_mtime_ns
    except OSError:  # the run has ended since it was found
        return 0


JOIN_TIMEOUT_S = 60.0
TELL_S = 1.0
FIRST_OPEN_MS, LONGEST_OPEN_MS = 400, 3_200  # meanwhile nothing else, no signal either, is handled
ASK_S = 2.0
PRESENCE_S = 0.5
POLL_S = 0.1
LOST_S = 25.0  # the liveliness token of a lost machine stays for the lease of 20 s


class WaitingTime:
    """Waits for a bus for `JOIN_TIMEOUT_S`, or without limit; prints once that it waits."""

    def __init__(self, what: str, console: Console, *, endless: bool) -> None:
        self._what = what
        self._console = console
        self._endless = endless
        self._began_s = time.monotonic()
        self._is_reported = self._is_over = False

    def wait(self, why: BusError) -> None:
        """Sleeps for a moment.

        Raises:
            BusError: the given one, once the time is over.
        """
        waited_s = time.monotonic() - self._began_s
        if waited_s >= TELL_S and not self._is_reported:
            self._is_reported = True
            hint = "`cpnet doctor --connect` tells what is wrong"
            print_line(self._console, f"waiting for {self._what} (Ctrl-C ends); {hint}")
        if waited_s >= JOIN_TIMEOUT_S and not self._is_over:
            if not self._endless:
                raise why
            self._is_over = True
            print_line(self._console, f"still waiting: {why}")
        time.sleep(POLL_S)


class WorldConnection:
    """A connection to the world bus of a run elsewhere: its setup and its processes."""

    def __init__(
        self, bus: ZenohBus, endpoint: Endpoint, console: Console, *, wait_forever: bool
    ) -> None:
        self._bus = bus
        self._endpoint = endpoint
        self._console = console
        self._wait_forever = wait_forever

    def setup(self) -> Setup:
        """Returns the run's setup.

        Raises:
            BusError: no process served it in time, or all speak another version of the protocol.
            ProtocolError: the reply is no setup.
        """
        what = f"the world: nobody at {_place(self._endpoint)} tells the setup of a run"
        waiting = WaitingTime(what, self._console, endless=self._wait_forever)
        nobody = BusError(f"{self._endpoint.locator} is up, but nobody there serves setup")
        while (setup := self._bus.ask("setup", Setup, ASK_S)) is None:
            self._refuse_strangers()
            waiting.wait(nobody)
        return setup

    def refuse_duplicates(self, ids: Iterable[str]) -> None:
        """Checks that no process on this bus has one of these ids.

        With `wait_forever`, the token of a machine that was lost is given time to expire.

        Raises:
            ConfigError: one has.
        """
        gone_by_s = time.monotonic() + (LOST_S if self._wait_forever else 0)
        wanted, is_reported = set(ids), False
        while duplicates := sorted(wanted.intersection(self._roll().present)):
            if time.monotonic() >= gone_by_s:
                raise ConfigError(
                    f"{', '.join(duplicates)} runs on this bus already: stop it, or take another "
                    "with --only"
                )
            if not is_reported:
                print_line(self._console, f"waiting for another {', '.join(duplicates)} to be gone")
            is_reported = True
            time.sleep(POLL_S)

    def _roll(self) -> PresentProcesses:
        return PresentProcesses.of(self._bus.list_present(PRESENCE_S))

    def _refuse_strangers(self) -> None:
        """Fails at once if all processes there speak another version of the protocol."""
        roll = self._roll()
        if roll.other_versions and not roll.present:
            raise BusError(f"{self._endpoint.locator}: {roll.mismatch()}")


def print_line(console: Console, text: str) -> None:
    """Prints a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def connected_to_world(
    endpoint: Endpoint, console: Console, *, wait_forever: bool
) -> Iterator[WorldConnection]:
    """Opens the world's bus as soon as it is there.

    Zenoh keeps the main thread while it opens, and signals with it, so it tries for short times;
    they grow, because a slow link takes longer. With `wait_forever` it never gives up.

    Raises:
        BusError: nothing answered in time.
    """
    bus = _opened(endpoint, WaitingTime(_named(endpoint), console, endless=wait_forever))
    try:
        yield WorldConnection(bus, endpoint, console, wait_forever=wait_forever)
    finally:
        bus.close()


def _opened(endpoint: Endpoint, waiting: WaitingTime) -> ZenohBus:
    timeout_ms = FIRST_OPEN_MS
    while True:
        try:
            return open_bus(BusName.WORLD, endpoint, Inbox(), timeout_ms)
        except BusError:
            waiting.wait(BusError(unanswered(BusName.WORLD, endpoint, JOIN_TIMEOUT_S)))
        timeout_ms = min(2 * timeout_ms, LONGEST_OPEN_MS)


def _named(endpoint: Endpoint) -> str:
    return f"the world bus at {_place(endpoint)}"


def _place(endpoint: Endpoint) -> str:
    return endpoint.locator.partition("/")[2]
