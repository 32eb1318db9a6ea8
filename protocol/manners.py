"""Who looks on holds up nobody: what its link does not take at once, the router drops.

All that is said on a bus is sent so that it blocks its sender while the link is full. A router
passes on what comes to one receiver after the other: a viewer that is stopped, or behind a slow
network, would block them all until the router gives it up, 5 s later. So an onlooker says with its
session's id, one of those below, that it would rather miss something; each router knows them.
"""

from __future__ import annotations

import secrets
from typing import Any

_BEGINNING = "c9"
_IDS = tuple(f"{_BEGINNING}{number:03x}f" for number in range(1024))
"""So many that two onlookers hardly ever have the same one: the second would not get in."""


def onlooker_id() -> str:
    """Returns an id for the session of somebody who may miss what comes too fast."""
    return secrets.choice(_IDS)


def dropping() -> list[dict[str, Any]]:
    """Returns a router's setting `qos/network`: what it sends to onlookers may be dropped."""
    return [
        {
            "id": "onlookers",
            "zids": list(_IDS),
            "flows": ["egress"],
            "messages": ["put"],
            "key_exprs": ["**"],
            "overwrite": {"congestion_control": "drop"},
        }
    ]
