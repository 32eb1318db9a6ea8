"""Whether the certificates of a folder can be used, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from cpnet.doctor.finding import Finding
from cpnet.key_check import check_key
from cpnet.processes import ROLES
from protocol.errors import ConfigError
from protocol.keys import AUTHORITY

SOON_DAYS = 30
_HOSTS = {row.role for row in ROLES if row.hosts}


def certificates(folder: Path) -> Iterator[Finding]:
    """Looks through all that is there."""
    names = sorted(path.stem for path in folder.glob("*.pem") if path.name != AUTHORITY)
    if not names:
        advice = f"--keys {folder}: there is none; `cpnet keys` makes them"
        yield Finding("certificates", "certificates", ok=False, advice=advice)
    for name in names:
        yield _certificate(folder, name)


def _certificate(folder: Path, name: str) -> Finding:
    what = f"the certificate of {name}"
    try:
        until = check_key(folder, name, hosts=name in _HOSTS)
    except ConfigError as error:
        return Finding("certificate", what, ok=False, advice=str(error))
    days = (until - datetime.now(UTC)).days
    soon = days < SOON_DAYS
    return Finding(
        "certificate",
        f"{what} holds until {until:%Y-%m-%d}",
        ok=not soon,
        advice=f"{days} days are left: `cpnet keys` makes another once it is removed"
        if soon
        else "",
        optional=True,
        measured={"process": name, "days_left": days},
    )
