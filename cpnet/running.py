"""Where the buses of a run are while it goes on, for whoever wants to look on: RUN/buses.json."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cpnet.endpoints import Endpoints, connecting, places
from cpnet.run_folder import written
from cpnet.security import VIEW
from protocol.access import Keys
from protocol.bus import Endpoint
from protocol.config import is_file, is_folder
from protocol.errors import ConfigError
from protocol.topics import BusName

FILE_NAME = "buses.json"
RUNS = Path("runs")
_ORDER = (BusName.V2X, BusName.WORLD)


@dataclass(frozen=True, slots=True)
class Running:
    """A run that goes on, here or elsewhere; the folder is None where it is elsewhere."""

    v2x: Endpoint
    world: Endpoint
    run_dir: Path | None = None


@contextmanager
def noted(run_dir: Path, endpoints: Endpoints, keys: Path | None) -> Iterator[None]:
    """Says in the run folder where the buses are, as long as the context lasts.

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


def find(run: Path | None, connect: list[str], keys: Path | None) -> Running:
    """Returns the run that is meant: one elsewhere, that of a folder, or the newest that goes on.

    Raises:
        ConfigError: there is none, or its place or its keys cannot be used.
    """
    if connect:
        if run is not None:
            raise ConfigError(f"{run}: give a run folder or --connect, not both")
        return _elsewhere(connect, keys)
    return _newest(keys) if run is None else _in(run, keys)


def _elsewhere(connect: list[str], keys: Path | None) -> Running:
    found = places("--connect", connect, "tls" if keys else "tcp")
    if missing := [bus.value for bus in BusName if bus not in found]:
        raise ConfigError(f"--connect: where is the {missing[0]} bus? {missing[0]}=HOST:PORT")
    own = _own(keys)
    v2x, world = (Endpoint(found[bus], listen=False, keys=own) for bus in _ORDER)
    return Running(v2x, world)


def _newest(keys: Path | None) -> Running:
    for path in sorted(RUNS.glob(f"*/{FILE_NAME}"), key=_age_ns):
        if _is_alive(path):
            return _in(path.parent, keys)
    raise ConfigError(
        f"no run goes on in {RUNS}/: give its folder, or --connect HOST:PORT if it is elsewhere"
    )


def _in(run_dir: Path, keys: Path | None) -> Running:
    path = run_dir / FILE_NAME
    if not is_file(path) or not _is_alive(path):
        raise ConfigError(f"{run_dir}: no run goes on there; {_instead(run_dir)}")
    facts = _facts(path)
    own = _own(keys or (Path(facts["keys"]) if "keys" in facts else None))
    try:
        v2x, world = (Endpoint(facts[bus.value], listen=False, keys=own) for bus in _ORDER)
    except KeyError as error:
        raise ConfigError(f"{path} does not say where the bus {error} is") from None
    return Running(v2x, world, run_dir)


def _instead(run_dir: Path) -> str:
    """Returns what can be done with a folder in which no run goes on."""
    if is_file(run_dir / "run.sqlite"):
        return f"it has ended: `cpnet report {run_dir}` says what came of it"
    if is_folder(run_dir) or is_file(run_dir):
        return "it is no run folder"
    return f"`cpnet up --out {run_dir}` would start one"


def _own(keys: Path | None) -> Keys | None:
    if keys is None:
        return None
    from cpnet.key_check import check_key  # the library of TLS takes its time to load

    check_key(keys, VIEW)
    return Keys.of(keys, VIEW)


def _facts(path: Path) -> dict[str, str]:
    try:
        return {name: str(value) for name, value in json.loads(path.read_text("utf-8")).items()}
    except (OSError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def _is_alive(path: Path) -> bool:
    """Whether the process that wrote it lives: one that was killed could not take it away."""
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
