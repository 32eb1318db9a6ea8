"""How tests wait: for what must come true, with a deadline, and never for a guessed time."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
PATIENCE_S = 15.0
_POLL_S = 0.002


def wait_until(holds: Callable[[], T], patience_s: float = PATIENCE_S, *, what: str = "") -> T:
    """Returns the first answer that is true; an assertion fails if none comes in time."""
    give_up_ns = time.monotonic_ns() + round(patience_s * 1e9)
    while not (answer := holds()):
        assert time.monotonic_ns() < give_up_ns, what or f"waited {patience_s:g} s in vain"
        time.sleep(_POLL_S)
    return answer
