"""Files that a user names."""

from __future__ import annotations

from pathlib import Path


def is_file(name: str | Path) -> bool:
    """Returns whether there is a file of this name, also where no file could have it."""
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long, or with a null byte
        return False
