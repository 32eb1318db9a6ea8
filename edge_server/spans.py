"""How long each stage of a frame took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from protocol.messages import Span


class Spans:
    """Collects the stages of one frame, in their order."""

    def __init__(self) -> None:
        self.done: list[Span] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what happens inside."""
        start_ns = time.monotonic_ns()
        yield
        self.done.append(Span(stage=name, start_ns=start_ns, end_ns=time.monotonic_ns()))
