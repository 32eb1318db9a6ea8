"""Shared by all layouts: a table, numbers and intervals as text."""

from __future__ import annotations

from statistics import mean, stdev
from typing import Any

from scipy.stats import t as student_t

Rows = list[dict[str, Any]]
Table = list[list[str]]  # the first row is the head


def fixed(value: float | None, digits: int, factor: float = 1.0) -> str:
    """Returns a number with so many digits, a dash for None."""
    return "–" if value is None else f"{factor * value:.{digits}f}"


def interval(values: list[float], digits: int) -> str:
    """Returns the mean with half the width of its 95 % interval, Student's t."""
    if len(values) < 2:
        return fixed(mean(values), digits) if values else "–"
    half = float(student_t.ppf(0.975, len(values) - 1)) * stdev(values) / len(values) ** 0.5
    return f"{fixed(mean(values), digits)} ± {fixed(half, digits)}"


def between(values: list[float], digits: int) -> str:
    """Returns an interval as `interval` does; below five values, the values themselves."""
    if len(values) >= LEAST_SEEDS:
        return interval(values, digits)
    return ", ".join(fixed(value, digits) for value in sorted(values))


LEAST_SEEDS = 5
