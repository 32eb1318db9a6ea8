"""What cannot be written into a run folder is told as a user's mistake, not as a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import ConfigError


@contextmanager
def written(run_dir: Path) -> Iterator[None]:
    """Guards what writes there.

    Raises:
        ConfigError: the disk is full, or may not be written.
    """
    try:
        yield
    except OSError as error:
        raise ConfigError(f"run folder {run_dir} cannot be written: {error}") from None
