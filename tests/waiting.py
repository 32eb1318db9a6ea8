"""How tests wait: for what must come true, never for a guessed time."""

import time
from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")
TIMEOUT_S = 300.0
"""Far more than a loaded machine needs: only what never comes true waits that long."""

_POLL_S = 0.002
_LONGEST_PAUSE_S = 0.1
_PAUSE_SHARE = 4
"""A pause is so many times as long as the question took: what is waited for needs the core."""


class Running(Protocol):
    """A process on which it depends whether something still can come true."""

    def poll(self) -> int | None: ...


def wait_until(
    holds: Callable[[], T],
    timeout_s: float = TIMEOUT_S,
    *,
    what: str | Callable[[], str] = "",
    needs: Running | None = None,
) -> T:
    """Returns the first answer that is true; an assertion fails if none can come any more.

    That is so after `timeout_s`, and at once when the process `needs` has ended. `what` says then
    what was missing.
    """

    def missing() -> str:
        return (what() if callable(what) else what) or f"waited {timeout_s:g} s in vain"

    give_up_ns = time.monotonic_ns() + round(timeout_s * 1e9)
    while True:
        ended = needs is not None and needs.poll() is not None
        asked_ns = time.monotonic_ns()
        if answer := holds():
            return answer
        took_s = (time.monotonic_ns() - asked_ns) / 1e9
        assert not ended, f"the process that it depends on has ended: {missing()}"
        assert time.monotonic_ns() < give_up_ns, missing()
        time.sleep(min(max(_POLL_S, _PAUSE_SHARE * took_s), _LONGEST_PAUSE_S))
