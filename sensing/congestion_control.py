"""Congestion control of a TCP sender: CUBIC as Linux 6 has it.

CUBIC (RFC 9438) with its friendliness towards Reno, proportional rate reduction during recovery
(RFC 6937), slow start after idle times and after a time in which the window was not used (RFC
2861). Windows are in packets; roundings are the kernel's, for they decide when a small one grows.
HyStart is left out: it matters before the first loss only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

INITIAL_WINDOW = 10  # RFC 6928
_BETA, _SCALE = 717, 1024  # the window is multiplied by 0.7 at a loss
_CUBIC_PER_S3 = 0.4
_KEPT_NS = 31_000_000  # Linux computes the growth of the same window anew after this
_MAX_ACKS_BEFORE_LOSS = 20  # for one more packet, as long as no loss gave a window to aim at


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Effect of an acknowledgement; amounts in packets."""

    now_ns: int
    delivered: int
    newly_lost: int
    in_flight: int
    is_advanced: bool
    least_rtt_ns: int
    is_recovering: bool


class Cubic:
    """The window of one sender, in packets."""

    def __init__(self) -> None:
        self.window = INITIAL_WINDOW
        self._threshold: float = math.inf  # below it slow start doubles the window
        # Growth since the last loss: the window before it, and what Reno would have by now.
        self._window_before_loss = 0
        self._epoch_ns: int | None = None
        self._inflection_s = 0.0
        self._inflection = 0
        self._reno_window = 0
        self._epoch_acks = 0
        self._acks_per_packet = 1
        self._computed = (0, 0)  # for which window and when
        self._credit = 0
        # Reduction during recovery.
        self._window_at_loss = 0
        self._delivered_since_loss = self._sent_since_loss = 0
        # Whether what was sent used the window.
        self._is_limited = False
        self._most_out = self._used = 0
        self._judged_until = 0
        self._judged_ns = 0

    def on_transmit(self) -> None:
        """Counts a packet, be it new or repeated."""
        self._sent_since_loss += 1

    def on_new_data(
        self, now_ns: int, first: int, end: int, *, is_limited: bool, timeout_ns: int, is_open: bool
    ) -> None:
        """Decides whether the window is the limit; packets from `first` to `end` are in flight."""
        out = end - first
        if (
            first >= self._judged_until
            or is_limited
            or (not self._is_limited and out > self._most_out)
        ):
            self._is_limited, self._most_out, self._judged_until = is_limited, out, end
        if self._is_window_used():
            self._used, self._judged_ns = 0, now_ns
            return
        self._used = max(self._used, out)
        if now_ns - self._judged_ns >= timeout_ns:
            used = max(self._used, INITIAL_WINDOW)
            if is_open and used < self.window:
                self._keep_threshold()
                self.window = (self.window + used) // 2
            self._used, self._judged_ns = 0, now_ns

    def on_start(self, now_ns: int, idle_ns: int) -> None:
        """Subtracts time in which nothing was in flight from the age of the epoch."""
        if self._epoch_ns is not None:
            self._epoch_ns = min(self._epoch_ns + idle_ns, now_ns)

    def on_idle(self, now_ns: int, idle_ns: int, timeout_ns: int) -> None:
        """Halves the window for each timeout with nothing in flight, down to the initial one."""
        if idle_ns <= timeout_ns:
            return
        self._keep_threshold()
        least = min(INITIAL_WINDOW, self.window)
        left_ns = idle_ns - timeout_ns
        while left_ns > 0 and self.window > least:
            self.window //= 2
            left_ns -= timeout_ns
        self.window = max(self.window, least)
        self._used, self._judged_ns = 0, now_ns

    def on_loss(self) -> None:
        """Begins a recovery."""
        self._window_at_loss = self.window
        self._reduce()
        self._credit = self._delivered_since_loss = self._sent_since_loss = 0

    def on_late_loss(self, in_flight: int) -> None:
        """A timer, not an acknowledgement, has begun the recovery: one packet may leave."""
        self._delivered_since_loss = 1
        self.window = in_flight + 1

    def on_recovered(self) -> None:
        """Ends a recovery that no timeout interrupted."""
        self.window = int(self._threshold)

    def on_timeout(self, in_flight: int, *, is_first: bool) -> None:
        """Starts again from one packet, with nothing known of the window before."""
        if is_first:
            self._reduce()
        self.window = in_flight + 1
        self._credit = self._window_before_loss = 0
        self._computed = (0, 0)

    def on_ack(self, ack: Acknowledged) -> None:
        """Grows the window, or spreads its reduction over a round trip."""
        if ack.is_recovering:
            self._reduce_in_proportion(ack)
        elif ack.is_advanced:
            self._judged_ns = ack.now_ns
            if self._is_window_used():
                self._grow(ack)

    def _is_window_used(self) -> bool:
        in_slow_start = self.window < self._threshold
        return self._is_limited or (in_slow_start and self.window < 2 * self._most_out)

    def _keep_threshold(self) -> None:
        self._threshold = max(self._threshold, self.window * 3 // 4)

    def _reduce(self) -> None:
        self._epoch_ns = None
        before, self._window_before_loss = self._window_before_loss, self.window
        if self.window < before:  # fast convergence: it yields to new flows
            self._window_before_loss = self.window * (_SCALE + _BETA) // (2 * _SCALE)
        self._threshold = max(2, self.window * _BETA // _SCALE)

    def _reduce_in_proportion(self, ack: Acknowledged) -> None:
        if ack.delivered <= 0:
            return
        self._delivered_since_loss += ack.delivered
        goal = int(self._threshold)
        if ack.in_flight > goal:
            share = goal * self._delivered_since_loss + self._window_at_loss - 1
            count = share // self._window_at_loss - self._sent_since_loss
        else:
            count = max(self._delivered_since_loss - self._sent_since_loss, ack.delivered)
            count += ack.is_advanced and not ack.newly_lost
            count = min(goal - ack.in_flight, count)
        self.window = ack.in_flight + max(count, 0 if self._sent_since_loss else 1)

    def _grow(self, ack: Acknowledged) -> None:
        acked = ack.delivered
        if self.window < self._threshold:
            grown = int(min(acked, self._threshold - self.window))
            self.window += grown
            acked -= grown
            if acked == 0:
                return
        self._compute_growth(ack, acked)
        if self._credit >= self._acks_per_packet:  # gathered while one packet took more of them
            self._credit = 0
            self.window += 1
        self._credit += acked
        more, self._credit = divmod(self._credit, self._acks_per_packet)
        self.window += more

    def _compute_growth(self, ack: Acknowledged, acked: int) -> None:
        """Finds how many acknowledged packets one more packet in the window takes."""
        window = self.window
        self._epoch_acks += acked
        if self._computed[0] == window and ack.now_ns - self._computed[1] <= _KEPT_NS:
            return
        self._computed = (window, ack.now_ns)
        if self._epoch_ns is None:
            self._epoch_ns, self._epoch_acks, self._reno_window = ack.now_ns, acked, window
            missing = max(0, self._window_before_loss - window)
            self._inflection_s = (missing / _CUBIC_PER_S3) ** (1 / 3)
            self._inflection = window + missing
        time_s = (ack.now_ns + ack.least_rtt_ns - self._epoch_ns) / 1e9
        target = self._inflection + int(_CUBIC_PER_S3 * (time_s - self._inflection_s) ** 3)
        acks = window // (target - window) if target > window else 100 * window
        if self._window_before_loss == 0:
            acks = min(acks, _MAX_ACKS_BEFORE_LOSS)
        reno_acks = window * 15 // 8
        while self._epoch_acks > reno_acks:
            self._epoch_acks -= reno_acks
            self._reno_window += 1
        if self._reno_window > window:
            acks = min(acks, window // (self._reno_window - window))
        self._acks_per_packet = max(acks, 2)
