"""Numbers in text files that people and other programs wrote."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from protocol.errors import ConfigError

MAX_FILE_BYTES = 64 << 20


def lines_of(path: Path) -> list[str]:
    """Returns the lines of a text file.

    Raises:
        ConfigError: it cannot be read, or is too large.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{path} has {path.stat().st_size} bytes, limit {MAX_FILE_BYTES}")
        return path.read_text("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None


def numbers_of(words: Sequence[str | None], where: str) -> list[float]:
    """Returns finite numbers of words; `where` begins what an error says.

    Raises:
        ConfigError: a word is none.
    """
    found = []
    for word in words:
        try:
            number = float(word or "")
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ConfigError(f"{where}: {word!r:.40} is no finite number")
        found.append(number)
    return found
