"""Guards against `multiprocessing` running the program's script again in child processes."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from protocol.errors import ConfigError

GUARD = 'if __name__ == "__main__":'


@contextmanager
def without_main() -> Iterator[None]:
    """Context manager: child processes started meanwhile do not run the program's script again."""
    own = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = own


def check_not_again() -> None:
    """Checks that this process is no child that runs the program's script again at its start.

    Raises:
        ConfigError: it is one: what the script does at its top level, each child would do too.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.tracebacklimit = 0  # this process ends by it: only the text is useful
        raise ConfigError(guard_needed("a child process runs this script again"))


def guard_needed(why: str) -> str:
    """Returns a text for the author of a script that starts processes."""
    return f"{why}: put what calls cpnet under `{GUARD}` (docs/python.md)"
