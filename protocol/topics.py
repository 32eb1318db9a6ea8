"""The topic table: key, message, bus, delivery, publishers and subscribers of each topic."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from urllib.parse import quote, unquote

from protocol import messages as m
from protocol.errors import MessageError
from protocol.limits import MAX_ID_CHARS
from protocol.wire import VERSION

PREFIX = f"cpnet/v{VERSION}"


class BusName(Enum):
    """`WORLD` stands for physics and is never counted; `V2X` is the network under study."""

    WORLD = "world"
    V2X = "v2x"


class Delivery(Enum):
    """How a message travels: all arrive whole and block their sender while the link is full.

    `PROMPT` is small, goes first and is not batched; `TELEMETRY` goes last. Only messages of one
    sender and one delivery keep their order.
    """

    BULK = "bulk"
    PROMPT = "prompt"
    TELEMETRY = "telemetry"


Roles = frozenset[str]


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table; `{names}` in the template are filled in by `key`.

    Only `publishers` may publish it and only `subscribers` receive it, by role; where the key holds
    `{process}`, each publisher under its own id alone.
    """

    name: str
    template: str
    message: type[m.Message]
    bus: BusName
    delivery: Delivery
    publishers: Roles
    subscribers: Roles

    def key(self, **parts: str) -> str:
        """Returns the Zenoh key expression; a part that is left out becomes `*`.

        Characters with a meaning to Zenoh, such as `/`, `#` and spaces, are percent-encoded.

        Raises:
            ValueError: a part is empty.
        """
        if "" in parts.values():
            raise ValueError(f"a key of topic {self.name} cannot have an empty part")
        names = re.findall(r"{(\w+)}", self.template)
        written = {n: quote(parts[n], safe="") if n in parts else "*" for n in names}
        return f"{PREFIX}/" + self.template.format(**written)

    def process(self, key: str) -> str | None:
        """Returns the process that signs a key of this topic, None if none signs such keys.

        As it stands there, percent-encoded or not, and empty where the key is none of the topic's:
        it only distinguishes senders.
        """
        place = _process_place(self.template)
        if place is None:
            return None
        parts = key.split("/", place + 1)
        return parts[place] if place < len(parts) else ""

    def parts(self, key: str) -> dict[str, str]:
        """Reads the parts of a key that this topic's own `key` made.

        Raises:
            MessageError: it is none. What is published at an expression such as `cpnet/**` comes
                to all whom that matches, with the expression for a key.
        """
        names = self.template.split("/")
        values = key.removeprefix(f"{PREFIX}/").split("/")
        if len(values) != len(names) or "*" in key:
            raise MessageError(f"{key:.200} is no key of topic {self.name}")
        return {
            n[1:-1]: unquote(v) for n, v in zip(names, values, strict=True) if n.startswith("{")
        }


@cache
def _process_place(template: str) -> int | None:
    names = f"{PREFIX}/{template}".split("/")
    return names.index("{process}") if "{process}" in names else None


_W, _V = BusName.WORLD, BusName.V2X
_B, _P, _T = Delivery.BULK, Delivery.PROMPT, Delivery.TELEMETRY

_AGENTS = frozenset({"vehicle", "infra"})
_SIM, _EDGE, _SIGNAL, _RECORD = (frozenset({r}) for r in ("sim", "edge", "signal", "record"))
OBSERVERS = frozenset({"view", "mcap"})
"""Roles that subscribe to everything and publish nothing (a recording: its clock alone)."""
_WATCH = frozenset({"watch"})  # the supervisor on each machine: progress alone
_RELAY = frozenset({"relay"})
_ROUTER = frozenset({"router"})  # hosts the V2X bus, publishes only its clock offset
_ALL = _AGENTS | _SIM | _EDGE | _SIGNAL | _RECORD
_CLOCKS = _ALL | _RELAY | _ROUTER | {"mcap"}
ROLES = _ALL | OBSERVERS | _WATCH | _RELAY | _ROUTER
"""All roles that may be on a bus."""


def _table(*rows: Topic) -> dict[str, Topic]:
    return {row.name: replace(row, subscribers=row.subscribers | OBSERVERS) for row in rows}


TOPICS = _table(
    Topic("setup", "world/setup", m.Setup, _W, _B, _SIM, ROLES),
    Topic("tick", "world/tick", m.Tick, _W, _P, _SIM, _AGENTS | _RECORD),
    Topic("bodies", "world/tick/{tile}", m.TileBodies, _W, _P, _SIM, _AGENTS),
    Topic("tiles", "world/tiles/{process}", m.TileRequest, _W, _P, _AGENTS, _SIM),
    Topic("truth", "world/truth", m.Truth, _W, _B, _SIM, _RECORD),
    Topic("sighting", "world/sighting/{agent}", m.Sighting, _W, _B, _AGENTS, _RECORD),
    Topic("trips", "world/trips", m.Trips, _W, _B, _SIM, _RECORD),
    Topic("end", "world/end", m.End, _W, _B, _SIM, _AGENTS | _RELAY | _RECORD | _WATCH),
    Topic("progress", "world/progress", m.Progress, _W, _T, _RECORD, _WATCH),
    Topic("time", "world/time", m.TimeReply, _W, _P, _SIM, ROLES),
    Topic("clock", "world/clock/{process}", m.ClockReading, _W, _T, _CLOCKS, _RECORD),
    Topic("state", "signal/{tls}/state", m.SignalState, _V, _P, _SIM, _EDGE | _SIGNAL | _RECORD),
    Topic("request", "signal/{tls}/request", m.SignalRequest, _V, _P, _SIGNAL, _SIM | _RECORD),
    Topic("advice", "signal/{tls}/advice/{agent}", m.SpeedAdvice, _V, _P, _SIGNAL, _SIM),
    Topic("roster", "{region}/roster/{process}", m.Roster, _V, _P, _AGENTS, _EDGE),
    Topic("pose", "{region}/pose/{process}/{agent}", m.AgentPose, _V, _P, _AGENTS, _EDGE),
    Topic(
        "scan",
        "{region}/scan/{process}/{agent}/{chunk}",
        m.Scan,
        _V,
        _B,
        _AGENTS,
        _EDGE | _RECORD,
    ),
    Topic("objects", "{region}/objects/{process}/{agent}", m.Objects, _V, _P, _AGENTS, _EDGE),
    Topic("plan", "{region}/plan/{agent}", m.Plan, _V, _P, _EDGE, _AGENTS),
    Topic("detections", "{region}/detections", m.Detections, _V, _P, _EDGE, _SIGNAL | _RECORD),
    Topic("border", "{region}/border", m.BorderObjects, _V, _P, _EDGE, _EDGE),
    Topic("lanes", "{region}/lanes/{tls}", m.LaneCounts, _V, _P, _EDGE, _SIGNAL | _RECORD),
    # Measuring must not load the network.
    Topic("metrics", "metrics/{process}", m.Metrics, _W, _T, _ALL, _RECORD | _WATCH),
)
"""All topics by name. Liveliness tokens stand at `alive/{role}/{id}` on both buses."""

QUERIED = frozenset({"setup", "time"})
"""Topics that are not published but queried, from the host of their bus."""

ALIVE = f"{PREFIX}/alive"
ALIVE_IN_ANY = "cpnet/*/alive/*/*"
"""The tokens of any version of the protocol."""

OWN_VERSION = PREFIX.partition("/")[2]

PRESENCE_WATCHERS = {
    BusName.WORLD: _SIM | _RECORD | OBSERVERS | _WATCH,
    BusName.V2X: _SIM | _EDGE | OBSERVERS | _WATCH,
}
"""Roles that may watch, on each bus, which processes are present."""

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")  # none of these either


def alive_parts(key: str) -> tuple[str, str]:
    """Returns role and id of the process whose liveliness token stands at a key.

    Raises:
        MessageError: no process of this system announces itself so.
    """
    names = key.removeprefix(f"{ALIVE}/").split("/")
    is_long = max(map(len, names)) > MAX_ID_CHARS
    if len(names) != 2 or is_long or "*" in key or _CONTROL.search(key):
        raise MessageError(f"{key:.200} is no key of a liveliness token")
    return names[0], names[1]
