"""Notices when a run that had begun stands still, and says so once, and again when it goes on."""

from __future__ import annotations

from collections.abc import Iterable

PATIENCE_NS = 3_000_000_000


class Stillness:
    """Turns what was last heard into what is to be said of it.

    A run may be slow: only a silence longer than any before it is one.
    """

    def __init__(self) -> None:
        self._frame: int | None = None
        self._since_ns = 0
        self._longest_ns = PATIENCE_NS
        self._is_still = False
        self._stopped: set[str] = set()

    def frames(self, frame: int | None, now_ns: int) -> str | None:
        """Takes the newest frame heard of, None before the first."""
        silent_ns = now_ns - self._since_ns
        if frame != self._frame:
            if self._frame is not None:
                self._longest_ns = max(self._longest_ns, silent_ns)
            was_still, self._is_still = self._is_still, False
            self._frame, self._since_ns = frame, now_ns
            return f"frames come again, after {silent_ns / 1e9:.0f} s" if was_still else None
        if frame is None or self._is_still or silent_ns <= self._longest_ns:
            return None
        self._is_still = True
        return f"no frame for {silent_ns / 1e9:.0f} s"

    def stopped(self, processes: Iterable[str]) -> list[str]:
        """Takes who has been stopped for longer than anybody waits."""
        now = set(processes)
        news = [
            f"nothing heard from {name}: it is stopped (SIGSTOP)" for name in now - self._stopped
        ]
        news += [f"{name} goes on" for name in self._stopped - now]
        self._stopped = now
        return sorted(news)
