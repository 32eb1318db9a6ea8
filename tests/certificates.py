"""Keys for tests: as `cpnet keys` makes them."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import pytest

from protocol.access import roles_of


def make_keys(
    folder: Path,
    *,
    vehicles: int = 2,
    regions: Sequence[str] = ("r0",),
    hosts: Sequence[str] = (),
    days: int = 365,
    now: datetime | None = None,
    more: Sequence[str] = (),
) -> Path:
    """Returns the folder, filled; skips the test where nothing can make keys."""
    pytest.importorskip("cryptography", reason="needs the extra `keys`")
    from cpnet.keys import add_keys

    add_keys(folder, [*roles_of(vehicles, regions), *more], hosts, days, now)
    return folder
