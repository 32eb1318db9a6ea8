"""Reports of processes that ended: id, exit status in words, the last lines of the log."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

from cpnet.fork_server import LOG_NAME, UNKNOWN_STATUS


def readable_line(line: str) -> str:
    """Returns a line of JSON as it would stand in a log of text, any other line as it is."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return line
    if not isinstance(record, dict) or not {"level", "message"} <= record.keys():
        return line
    words = (record.get(key) for key in ("time", "process", "level", "logger"))
    head = " ".join(str(word) for word in words if word)
    text = f"{head}: {record['message']}"
    return f"{text}\n{record['exception']}" if record.get("exception") else text


TAIL_LINES = 12
FULL_BYTES = 1 << 20
CLEAN_STATUSES = (
    0,
    UNKNOWN_STATUS,
)  # at the end; the status is unknown if the fork server has gone


@dataclass(frozen=True, slots=True)
class ExitReport:
    """A process that ended before the run did."""

    id: str
    how: str
    tail: str


def describe_status(status: int) -> str:
    """Returns an exit status in words, as the end of a sentence."""
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


def log_tail(path: Path, lines: int = TAIL_LINES) -> str:
    """Returns the last lines of a log; without one, those of the fork server's beside it."""
    try:
        text = path.read_text("utf-8", errors="replace")
    except OSError as error:
        return _instead_of(path, error, lines)
    shown = "\n".join(map(readable_line, text.splitlines()[-lines:]))
    return "\n".join(shown.splitlines()[-lines:]) or _why_empty(path.parent)


def _instead_of(path: Path, error: OSError, lines: int) -> str:
    """Explains a missing log: early output of a process is in the fork server's log."""
    other = path.with_name(LOG_NAME)
    if path == other or not other.is_file():
        return f"(no log: {error})"
    return f"(no log of its own; the fork server's, {other}, ends so:)\n{log_tail(other, lines)}"


def _why_empty(folder: Path) -> str:
    """Explains an empty log: the disk may be full."""
    if shutil.disk_usage(folder).free < FULL_BYTES:
        return f"(its log is empty: the disk that holds {folder} is full)"
    return "(its log is empty)"
