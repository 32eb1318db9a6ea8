"""Work that is shared between threads."""

from __future__ import annotations

import threading

import pytest

from perception import parallel
from perception.parallel import each
from tests.waiting import TIMEOUT_S


@pytest.mark.parametrize("cores", [1, 2, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_results_come_in_the_order_of_items(
    monkeypatch: pytest.MonkeyPatch, cores: int, count: int
) -> None:
    monkeypatch.setattr(parallel, "threads", lambda: cores)
    assert each(lambda item: item * item, range(count)) == [n * n for n in range(count)]


def test_all_threads_take_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "threads", lambda: 2)
    both = threading.Barrier(2, timeout=TIMEOUT_S)  # no thread gets past it alone
    names = each(lambda _: (both.wait(), threading.current_thread().name)[1], [0, 1])
    assert len(set(names)) == 2


def test_what_work_raises_is_raised() -> None:
    def fail(item: int) -> int:
        if item == 3:
            raise ValueError("three")
        return item

    for _ in range(20):
        with pytest.raises(ValueError, match="three"):
            each(fail, range(6))
    assert each(fail, [1, 2]) == [1, 2]
