"""Processes that ended before their time: who, how, and what they said last."""

from __future__ import annotations

import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

from cpnet.log_lines import readable
from cpnet.nursery import UNKNOWN_STATUS

TAIL_LINES = 12
FULL_BYTES = 1 << 20
WELL = (0, UNKNOWN_STATUS)  # at the end; who outlived the fork server has nobody to tell of it


@dataclass(frozen=True, slots=True)
class Death:
    """A process that ended before the run did."""

    id: str
    how: str
    tail: str


def how(status: int) -> str:
    """Returns what an exit status says, as the end of a sentence."""
    if status == UNKNOWN_STATUS:
        return "ended, and the fork server that would know how had gone"
    if status >= 0:
        return f"ended with status {status}"
    return f"was killed by {signal_name(-status)}"


def signal_name(number: int) -> str:
    """Returns the name of a signal; of real-time signals only two have one."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def tail(path: Path, lines: int = TAIL_LINES) -> str:
    """Returns the last lines of a log."""
    try:
        text = path.read_text("utf-8", errors="replace")
    except OSError as error:
        return f"(no log: {error})"
    told = "\n".join(map(readable, text.splitlines()[-lines:]))
    return "\n".join(told.splitlines()[-lines:]) or _why_empty(path.parent)


def _why_empty(folder: Path) -> str:
    """Says of an empty log whether the disk could not take what would stand in it."""
    if shutil.disk_usage(folder).free < FULL_BYTES:
        return f"(its log is empty: the disk that holds {folder} is full)"
    return "(its log is empty)"
