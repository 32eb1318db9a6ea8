"""Helpers to start processes: deferred signals while one starts, one thread for each BLAS."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Environment of processes: one BLAS thread each, since spinning on all cores slows the rest."""
DEFERRED = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Defers Ctrl-C and SIGTERM: a process whose start breaks off half-way prints a traceback.

    To block them would not do, for other threads may receive them. Signals are handled in the main
    thread, so that there is nothing to defer in another.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    before = {one: signal.signal(one, lambda n, _: received.append(n)) for one in DEFERRED}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    for number in received[:1]:
        signal.raise_signal(number)
