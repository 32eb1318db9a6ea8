"""How a process writes its log: lines for people, or one JSON object a line for programs."""

from __future__ import annotations

import logging
import sys
import threading
from enum import StrEnum
from types import TracebackType

_log = logging.getLogger(__name__)


class LogStyle(StrEnum):
    """What a line of a log is."""

    TEXT = "text"
    JSON = "json"


def configure(process: str, style: LogStyle) -> None:
    """Sends the process's log to standard error.

    As JSON, what ends the process or a thread unforeseen is a line as well; what libraries write
    past Python's logging stays as it is.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_json(process) if style is LogStyle.JSON else _text(process))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    if style is LogStyle.JSON:
        logging.captureWarnings(capture=True)
        sys.excepthook = _tell_end
        threading.excepthook = _tell_end_of_thread


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


def _tell_end(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    _log.critical("ended by an error", exc_info=(kind, error, trace))


def _tell_end_of_thread(ended: threading.ExceptHookArgs) -> None:
    error = ended.exc_value or ended.exc_type()
    name = ended.thread.name if ended.thread else "unknown"
    _log.critical(
        "the thread %s ended by an error",
        name,
        exc_info=(ended.exc_type, error, ended.exc_traceback),
    )
