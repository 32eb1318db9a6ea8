"""The base of configuration sections, and checks of the files that a user names."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A part of a scenario; each field has a default and a description."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )


def is_file(name: str | Path) -> bool:
    """Returns whether there is a file of this name."""
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long, or with a null byte
        return False


def is_folder(name: str | Path) -> bool:
    """Returns whether there is a folder of this name."""
    try:
        return Path(name).is_dir()
    except (OSError, ValueError):
        return False


def is_free(path: Path) -> bool:
    """Returns whether a new file may be made there: nothing is, but its folder."""
    try:
        path.lstat()
    except FileNotFoundError:
        return is_folder(path.parent)
    except (OSError, ValueError):
        return False
    return False
