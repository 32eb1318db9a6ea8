"""Removes namespaces and devices, one's own and those of runs that were killed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from link_relay.netns.enter import NAMESPACES
from link_relay.netns.iproute import NetnsError, call
from link_relay.netns.place import Place

_DEVICES = Path("/sys/class/net")


def remove(place: Place) -> None:
    """Removes a namespace and its devices, as far as they are there.

    The device first: the kernel may let a namespace without a name live on for a while.
    """
    with contextlib.suppress(NetnsError):
        call("ip", "link", "delete", place.device)
    with contextlib.suppress(NetnsError):
        call("ip", "netns", "delete", place.namespace)


def remove_of(pid: int) -> None:
    """Removes all that a process made and did not remove."""
    _remove_where(lambda owner: owner == pid)


def remove_leftovers() -> list[Place]:
    """Removes what processes made that are no more; returns what that was."""
    return _remove_where(lambda owner: not lives(owner))


def _remove_where(asked: Callable[[int], bool]) -> list[Place]:
    names = [entry.name for folder in (NAMESPACES, _DEVICES) for entry in _entries(folder)]
    places = {place for name in names if (place := Place.of(name)) and asked(place.pid)}
    found = sorted(places, key=lambda place: (place.pid, place.number))
    for place in found:
        remove(place)
    return found


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def lives(pid: int) -> bool:
    """Whether a process runs; one that waits to be buried does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8", errors="replace").rpartition(")")[2]
    except OSError:
        return False
    return state.split()[:1] != ["Z"]
