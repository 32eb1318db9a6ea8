"""Hostile signal requests, of every kind that a process on the V2X bus could send."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from protocol.messages import SignalRequest
from protocol.roadmap import Signal

S = 1_000_000_000
KINDS = (
    "random_phase",
    "random_letters",
    "replayed",
    "stale",
    "future",
    "other_signal",
    "wrong_alphabet",
    "wrong_length",
    "all_green",
    "all_red",
    "delayed",
    "begins_later",
)


class Hostile:
    """Makes requests for a signal; what it makes follows from the generator it is given."""

    def __init__(self, signal: Signal, rng: np.random.Generator) -> None:
        self._signal = signal
        self._size = len(signal.plan[0].state)
        self._rng = rng
        self._last_ns = 0
        self._makers: dict[str, Callable[[int], SignalRequest]] = {
            "random_phase": self._ask,
            "random_letters": lambda now_ns: self._ask(now_ns, self._letters("rgG")),
            "replayed": lambda _: self._ask(self._last_ns),
            "stale": lambda now_ns: self._ask(now_ns - self._between(4 * S, 10_000 * S)),
            "future": lambda now_ns: self._ask(now_ns + self._between(1, 10_000 * S)),
            "other_signal": lambda now_ns: self._ask(now_ns, tls="another"),
            "wrong_alphabet": lambda now_ns: self._ask(now_ns, self._letters("yoOsx") or "y"),
            "wrong_length": lambda now_ns: self._ask(now_ns, self._phase() + "G"),
            "all_green": lambda now_ns: self._ask(now_ns, "G" * self._size),
            "all_red": lambda now_ns: self._ask(now_ns, "r" * self._size),
            "delayed": lambda now_ns: self._ask(now_ns, delay_ns=self._between(0, 60 * S)),
            "begins_later": lambda now_ns: self._ask(now_ns, wait_ns=self._between(0, 5 * S)),
        }
        assert tuple(self._makers) == KINDS

    def make(self, kind: str, now_ns: int) -> SignalRequest:
        """Returns a request of a kind, as it would be sent at this simulated time."""
        made = self._makers[kind](now_ns)
        if kind == "random_phase":
            self._last_ns = now_ns
        return made

    def any(self, now_ns: int) -> SignalRequest:
        """Returns a request of a random kind."""
        return self.make(KINDS[self._rng.integers(len(KINDS))], now_ns)

    def _ask(
        self,
        sim_time_ns: int,
        state: str | None = None,
        tls: str | None = None,
        delay_ns: int | None = None,
        wait_ns: int = 0,
    ) -> SignalRequest:
        return SignalRequest(
            frame=int(self._rng.integers(1 << 39)),
            sim_time_ns=sim_time_ns,
            tls=tls or self._signal.tls,
            state=self._phase() if state is None else state,
            policy="hostile",
            delay_sim_ns=delay_ns,
            not_before_ns=sim_time_ns + wait_ns,
        )

    def _phase(self) -> str:
        greens = self._signal.greens
        return greens[self._rng.integers(len(greens))]

    def _letters(self, alphabet: str) -> str:
        return "".join(alphabet[n] for n in self._rng.integers(len(alphabet), size=self._size))

    def _between(self, low_ns: int, high_ns: int) -> int:
        return int(self._rng.integers(low_ns, high_ns))
