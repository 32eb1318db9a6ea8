"""Quantities that are constant between steps and repeat, with exact integrals in integers."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate, chain, pairwise


class Steps:
    """`values[i]` holds from `starts_ns[i]` until the next start; all repeats after `period_ns`.

    Times may be any integer: the pattern goes on in both directions.
    """

    def __init__(self, starts_ns: Sequence[int], values: Sequence[int], period_ns: int) -> None:
        ends_ns = [*starts_ns[1:], period_ns]
        if not starts_ns or starts_ns[0] != 0 or len(starts_ns) != len(values):
            raise ValueError("steps begin at 0 and have one value each")
        if any(a >= b for a, b in zip(starts_ns, ends_ns, strict=True)) or min(values) < 0:
            raise ValueError("steps ascend within the period and no value is negative")
        self.starts_ns = list(starts_ns)
        self.values = list(values)
        self.period_ns = period_ns
        spans = zip(self.starts_ns, ends_ns, self.values, strict=True)
        self._sums = [0, *accumulate((end - start) * value for start, end, value in spans)]
        self._total = self._sums[-1]
        self.largest = max(self.values)

    @classmethod
    def constant(cls, value: int) -> Steps:
        """Returns what never changes."""
        return cls([0], [value], 1_000_000_000)

    def at(self, time_ns: int) -> int:
        """Returns the value at a time."""
        return self.values[bisect_right(self.starts_ns, time_ns % self.period_ns) - 1]

    def changes(self, after_ns: int, until_ns: int) -> Iterator[int]:
        """Yields the starts of steps in (after, until], in their order."""
        turn, inside_ns = divmod(after_ns, self.period_ns)
        step = bisect_right(self.starts_ns, inside_ns)
        while True:
            if step == len(self.starts_ns):
                turn, step = turn + 1, 0
            start_ns = turn * self.period_ns + self.starts_ns[step]
            if start_ns > until_ns:
                return
            yield start_ns
            step += 1

    def integral(self, start_ns: int, end_ns: int) -> int:
        """Returns the integral, in value x ns."""
        return self._since_zero(end_ns) - self._since_zero(start_ns)

    def reach(self, start_ns: int, amount: int) -> int:
        """Returns the first whole ns at which the integral since the start is the amount or more.

        Raises:
            ValueError: all values are 0.
        """
        if amount <= 0:
            return start_ns
        if self._total == 0:
            raise ValueError("nothing ever passes: all values are 0")
        goal = self._since_zero(start_ns) + amount
        turns = (goal - 1) // self._total
        rest = goal - turns * self._total  # 1 to total: the first step that holds it is not 0
        step = bisect_left(self._sums, rest) - 1
        inside_ns = -((self._sums[step] - rest) // self.values[step])
        return turns * self.period_ns + self.starts_ns[step] + inside_ns

    def _since_zero(self, time_ns: int) -> int:
        turns, inside_ns = divmod(time_ns, self.period_ns)
        step = bisect_right(self.starts_ns, inside_ns) - 1
        into_ns = inside_ns - self.starts_ns[step]
        return turns * self._total + self._sums[step] + into_ns * self.values[step]


class Interrupted:
    """Steps that are 0 within spans, [start, end) each, ascending and apart; it repeats in turns.

    A span costs the same whether the steps within it are one or a million.
    """

    def __init__(self, steps: Steps, gone: Sequence[tuple[int, int]], turns: int) -> None:
        self._steps = steps
        self.largest = steps.largest
        self.period_ns = turns * steps.period_ns
        self._starts_ns = [0, *(end_ns for _, end_ns in gone)]  # of what is left
        self._ends_ns = [*(start_ns for start_ns, _ in gone), self.period_ns]
        edges_ns = [0, *chain.from_iterable(gone), self.period_ns]
        if any(a > b for a, b in pairwise(edges_ns)):
            raise ValueError("spans ascend within the period")
        spans = zip(self._starts_ns, self._ends_ns, strict=True)
        self._sums = [0, *accumulate(steps.integral(start, end) for start, end in spans)]

    def at(self, time_ns: int) -> int:
        """Returns the value at a time."""
        inside_ns = time_ns % self.period_ns
        there = inside_ns < self._ends_ns[bisect_right(self._starts_ns, inside_ns) - 1]
        return self._steps.at(inside_ns) if there else 0

    def integral(self, start_ns: int, end_ns: int) -> int:
        """Returns the integral, in value x ns."""
        return self._since_zero(end_ns) - self._since_zero(start_ns)

    def reach(self, start_ns: int, amount: int) -> int:
        """See `Steps.reach`."""
        total = self._sums[-1]
        if amount <= 0:
            return start_ns
        if total == 0:
            raise ValueError("nothing ever passes: all values are 0")
        turns, rest = divmod(self._since_zero(start_ns) + amount - 1, total)
        span = bisect_right(self._sums, rest) - 1
        inside_ns = self._steps.reach(self._starts_ns[span], rest + 1 - self._sums[span])
        return turns * self.period_ns + inside_ns

    def _since_zero(self, time_ns: int) -> int:
        turns, inside_ns = divmod(time_ns, self.period_ns)
        span = bisect_right(self._starts_ns, inside_ns) - 1
        until_ns = min(inside_ns, self._ends_ns[span])
        since_start = self._steps.integral(self._starts_ns[span], until_ns)
        return turns * self._sums[-1] + self._sums[span] + since_start
