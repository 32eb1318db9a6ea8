"""Names as labels: whatever the network says, a page of metrics has an end."""

from __future__ import annotations

import re

OTHER = "other"
_PLAIN = re.compile(r"[A-Za-z0-9_.:-]{1,64}")


class Names:
    """The first names of a kind, as many as there is room for; all others are called one."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._known: set[str] = set()

    def label(self, name: str) -> str:
        """Returns the name itself, or `other` if it is odd or came too late."""
        if name not in self._known:
            if len(self._known) >= self._limit or not _PLAIN.fullmatch(name):
                return OTHER
            self._known.add(name)
        return name

    def release(self, name: str) -> None:
        """Makes room for another name."""
        self._known.discard(name)
