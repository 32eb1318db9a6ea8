"""Where the world is: by its ticks, of which one alone may be absurd."""

from __future__ import annotations

from protocol.errors import MessageError

OPEN_FRAMES = 256
"""So many frames before the newest tick are still changed; what is older is settled."""


class Pulse:
    """Follows ticks; one that leads elsewhere is believed when the next goes on from there."""

    def __init__(self, period_ns: int, last: tuple[int, int] | None = None) -> None:
        """Begins after the last tick, frame and ns of simulation, that is known from before."""
        self._period_ns = period_ns
        self._last = last
        self._doubted: tuple[int, int] | None = None
        self.frame = last[0] if last else -1

    def take(self, frame: int, sim_time_ns: int) -> None:
        """Moves on to a tick.

        Raises:
            MessageError: it follows neither the last one nor one that was doubted.
        """
        tick = frame, sim_time_ns
        if not (self._goes_on(self._last, tick) or self._goes_on(self._doubted, tick)):
            self._doubted = tick
            raise MessageError(
                f"tick {frame} at {sim_time_ns / 1e9:g} s does not follow {self.frame}"
            )
        self._last, self._doubted, self.frame = tick, None, frame

    def _goes_on(self, before: tuple[int, int] | None, tick: tuple[int, int]) -> bool:
        frames = tick[0] - (before[0] if before else -1)
        if before is None:
            return self._last is None and frames <= OPEN_FRAMES
        due_ns = frames * self._period_ns  # SUMO rounds its steps to milliseconds
        return 0 < frames <= OPEN_FRAMES and due_ns / 2 <= tick[1] - before[1] <= 2 * due_ns
