"""What the log says of what came in and cannot be used, however much of it there is."""

from __future__ import annotations

import logging

MAX_LINES = 64
_TOLD = 200  # characters of a key or a reason
_log = logging.getLogger(__name__)


class Complaints:
    """One line for each topic and kind of fault, and so many in all.

    Keys and reasons do not count, for a sender may make new ones for ever.
    """

    def __init__(self) -> None:
        self._told: set[tuple[str, str]] = set()

    def refused(self, topic: str, key: str, error: Exception) -> None:
        """Tells of a message that is bad."""
        if rest := self._rest((topic, type(error).__name__)):
            _log.warning(
                "dropped a message on %s: %s (%s)", _printable(key), _printable(str(error)), rest
            )

    def failed(self, topic: str, error: Exception) -> None:
        """Tells of a message that its role could not take, by a fault of the role."""
        if rest := self._rest((topic, "role_error")):
            _log.error("a message on %s went wrong (%s)", _printable(topic), rest, exc_info=error)

    def _rest(self, news: tuple[str, str]) -> str:
        """Returns what becomes of those that come later, empty if this one is told of no more."""
        if news in self._told or len(self._told) >= MAX_LINES:
            return ""
        self._told.add(news)
        if len(self._told) == MAX_LINES:
            return f"line {MAX_LINES} of this kind, the last: all later ones are only counted"
        return "later ones are only counted"


def _printable(text: str) -> str:
    """Returns the beginning of what others wrote, so that it cannot break a line of the log."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text[:_TOLD])
