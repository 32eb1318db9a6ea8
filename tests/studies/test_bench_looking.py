"""What looking on costs is told from a run's ticks and from when somebody looked."""

import numpy as np
import pytest

from studies.bench_looking import SETTLES_NS, Span, rows_of

SPAN_NS = 4_000_000_000


def spans(*ways: str | None) -> list[Span]:
    return [Span(way, n * SPAN_NS, (n + 1) * SPAN_NS) for n, way in enumerate(ways)]


def ticks(*rates_hz: float) -> np.ndarray:
    """Returns ticks of a run that has these rates in spans one after the other."""
    begins = [n * SPAN_NS for n in range(len(rates_hz))]
    return np.concatenate(
        [
            begin + np.arange(0, SPAN_NS, 1e9 / rate_hz).astype(np.int64)
            for begin, rate_hz in zip(begins, rates_hz, strict=True)
        ]
    )


def test_a_share_is_that_of_the_neighbours_rate() -> None:
    (row,) = rows_of(ticks(10, 9, 10, 18, 30), spans(None, "record", None, "record", None))
    assert (row.way, row.spans) == ("record", 2)
    assert row.alone_hz == pytest.approx(15, rel=0.02)
    assert (row.low, row.share, row.high) == pytest.approx((0.9, 0.9, 0.9), rel=0.02)


def test_each_way_has_a_row_and_spans_without_frames_none() -> None:
    ways = spans(None, "record", None, "web", None, "save", None)
    rows = [*rows_of(ticks(20, 10, 20, 20, 20, 1, 20), ways)]
    assert [row.way for row in rows] == ["record", "web"]
    assert [row.share for row in rows] == pytest.approx([0.5, 1.0], rel=0.02)


def test_frames_just_after_a_change_do_not_count() -> None:
    slow = np.arange(SPAN_NS, SPAN_NS + SETTLES_NS, 200_000_000)
    fast = np.arange(SPAN_NS + SETTLES_NS, 2 * SPAN_NS, 50_000_000)
    around = ticks(20, 20, 20)
    beside = around[(around < SPAN_NS) | (around >= 2 * SPAN_NS)]
    (row,) = rows_of(np.concatenate([fast, slow, beside]), spans(None, "web", None))
    assert row.share == pytest.approx(1.0, rel=0.02)


def test_the_interval_is_of_the_median() -> None:
    ways = spans(*[None, "web"] * 20, None)
    rates = [10.0, 9.0, 10.0, 8.0] * 10 + [10.0]
    (row,) = rows_of(ticks(*rates), ways)
    assert 0.79 < row.low <= row.share <= row.high < 0.91
    assert row.low < row.high
    assert [*rows_of(ticks(*rates), ways)] == [row]
    assert row.as_json()["way"] == "web"
