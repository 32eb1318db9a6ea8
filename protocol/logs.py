"""The log of a process: its format, and rate-limited logging of messages that were dropped."""

from __future__ import annotations

import logging
import sys
import threading
from enum import StrEnum
from types import TracebackType

from protocol.limits import MAX_LOG_LINES, MAX_SHOWN_CHARS

_log = logging.getLogger(__name__)


class LogStyle(StrEnum):
    """Format of a log line: plain text or JSON."""

    TEXT = "text"
    JSON = "json"


def configure(process: str, style: LogStyle) -> None:
    """Sends the process's log to standard error.

    As JSON, uncaught exceptions of the process or a thread are lines as well; what libraries write
    without Python's logging stays as it is.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_json(process) if style is LogStyle.JSON else _text(process))
    logging.basicConfig(
        level=logging.INFO, handlers=[handler], force=True
    )  # whoever forked it logged
    if style is LogStyle.JSON:
        logging.captureWarnings(capture=True)
        sys.excepthook = _log_end
        threading.excepthook = _log_end_of_thread


def _text(process: str) -> logging.Formatter:
    name = process.replace("%", "%%")
    return logging.Formatter(f"%(asctime)s {name} %(levelname)s %(name)s: %(message)s")


def _json(process: str) -> logging.Formatter:
    from pythonjsonlogger.json import JsonFormatter  # few runs need it

    return JsonFormatter(
        ["levelname", "name", "message"],
        rename_fields={"levelname": "level", "name": "logger", "exc_info": "exception"},
        static_fields={"process": process},
        timestamp="time",
    )


def _log_end(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    _log.critical("ended by an error", exc_info=(kind, error, trace))


def _log_end_of_thread(ended: threading.ExceptHookArgs) -> None:
    error = ended.exc_value or ended.exc_type()
    name = ended.thread.name if ended.thread else "unknown"
    _log.critical(
        "the thread %s ended by an error",
        name,
        exc_info=(ended.exc_type, error, ended.exc_traceback),
    )


class RateLimitedLog:
    """Logs one line for each topic and kind of error, and `MAX_LOG_LINES` in all.

    Keys and reasons do not count: a sender could invent new ones without end.
    """

    def __init__(self) -> None:
        self._logged: set[tuple[str, str]] = set()

    def refused(self, topic: str, key: str, error: Exception) -> None:
        """Logs that a bad message was dropped."""
        if rest := self._rest((topic, type(error).__name__)):
            _log.warning(
                "dropped a message on %s: %s (%s)", _printable(key), _printable(str(error)), rest
            )

    def failed(self, topic: str, error: Exception) -> None:
        """Logs that a role failed on a message, by an error of its own."""
        if rest := self._rest((topic, "role_error")):
            _log.error("a message on %s went wrong (%s)", _printable(topic), rest, exc_info=error)

    def _rest(self, news: tuple[str, str]) -> str:
        """Returns a note on later ones; empty if this one is not logged either."""
        if news in self._logged or len(self._logged) >= MAX_LOG_LINES:
            return ""
        self._logged.add(news)
        if len(self._logged) == MAX_LOG_LINES:
            return f"line {MAX_LOG_LINES} of this kind, the last: all later ones are only counted"
        return "later ones are only counted"


def _printable(text: str) -> str:
    """Returns the beginning of received text, escaped so that it cannot break a log line."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text[:MAX_SHOWN_CHARS])
