"""How scans may be encoded; the bound on the error is chosen apart from it."""

from __future__ import annotations

from enum import StrEnum

from protocol.errors import CodecError


class Profile(StrEnum):
    """How much time a scan may take to become small. Every profile keeps the same bound.

    FAST: differences and zstd, the least time. DEFAULT: a model of the scene and an entropy coder,
    a third to a half of those bytes. DRACO: for comparison; unordered, and only where DracoPy is
    installed.
    """

    FAST = "fast"
    DEFAULT = "default"
    DRACO = "draco"


def profile_named(name: str) -> Profile:
    """Returns the profile of this name.

    Raises:
        CodecError: there is none.
    """
    try:
        return Profile(name)
    except ValueError:
        known = ", ".join(Profile)
        raise CodecError(f"profile {name!r}: must be one of {known}") from None
