"""Runs side by side, each in a process of its own, forked off one that has done their imports.

libsumo keeps state from one run to the next, which changes the results of the second, so no process
makes two; imports take seconds, as long as a short run itself.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver

_PRELOAD = ["studies.perceived_case", "studies.bench_control"]
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # runs take the cores


@contextmanager
def run_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Yields a pool of so many processes, a new one for each task.

    Ctrl-C does not reach them: what ends the block with an error ends them too, at once.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    os.environ.update(_ONE_THREAD)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is forked off inherits it
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
    with ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1) as pool:
        try:
            yield pool
        except BaseException:
            for child in multiprocessing.active_children():
                child.terminate()
            raise
