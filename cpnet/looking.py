"""What all commands that look on at a run say while they wait for it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from cpnet.discovery import RunLocation

TELL_AFTER_S = 2.0
FPS = 2.0
"""So many pictures a second at most, where nothing else is asked for."""


@contextmanager
def looking_for(run: RunLocation, console: Console) -> Iterator[None]:
    """Says what is looked for, if that takes a while."""
    where = f"{run.v2x.locator} and {run.world.locator}"

    def tell() -> None:
        console.print(
            f"looking for the run at {where}", markup=False, highlight=False, soft_wrap=True
        )

    timer = threading.Timer(TELL_AFTER_S, tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
