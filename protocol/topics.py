"""The topic table: what is said where, on which bus and with which delivery."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from urllib.parse import quote, unquote

from protocol import messages as m
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


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table; `{names}` in the template are filled in by `key`."""

    name: str
    template: str
    message: type[m.Message]
    bus: BusName
    delivery: Delivery

    def key(self, **parts: str) -> str:
        """Returns the Zenoh key expression; a part that is left out becomes `*`.

        What Zenoh gives a meaning to, such as `/`, `#` and spaces, stands percent-encoded.

        Raises:
            ValueError: a part is empty.
        """
        if "" in parts.values():
            raise ValueError(f"a key of topic {self.name} cannot have an empty part")
        names = re.findall(r"{(\w+)}", self.template)
        written = {n: quote(parts[n], safe="") if n in parts else "*" for n in names}
        return f"{PREFIX}/" + self.template.format(**written)

    def parts(self, key: str) -> dict[str, str]:
        """Reads the parts of a key that this topic's own `key` made."""
        names = self.template.split("/")
        values = key.removeprefix(f"{PREFIX}/").split("/")
        return {
            n[1:-1]: unquote(v) for n, v in zip(names, values, strict=True) if n.startswith("{")
        }


def _table(*rows: Topic) -> dict[str, Topic]:
    return {row.name: row for row in rows}


_W, _V = BusName.WORLD, BusName.V2X
_B, _P, _T = Delivery.BULK, Delivery.PROMPT, Delivery.TELEMETRY

TOPICS = _table(
    Topic("setup", "world/setup", m.Setup, _W, _B),
    Topic("tick", "world/tick", m.Tick, _W, _P),
    Topic("truth", "world/truth", m.Truth, _W, _B),
    Topic("sighting", "world/sighting/{agent}", m.Sighting, _W, _B),
    Topic("trips", "world/trips", m.Trips, _W, _B),
    Topic("end", "world/end", m.End, _W, _B),
    Topic("progress", "world/progress", m.Progress, _W, _T),
    Topic("time", "world/time", m.TimeReply, _W, _P),
    Topic("clock", "world/clock/{process}", m.ClockReading, _W, _T),
    Topic("state", "signal/{tls}/state", m.SignalState, _V, _P),
    Topic("request", "signal/{tls}/request", m.SignalRequest, _V, _P),
    Topic("roster", "{region}/roster/{process}", m.Roster, _V, _P),
    Topic("pose", "{region}/pose/{agent}", m.AgentPose, _V, _P),
    Topic("scan", "{region}/scan/{agent}/{chunk}", m.Scan, _V, _B),
    Topic("objects", "{region}/objects/{agent}", m.Objects, _V, _P),
    Topic("plan", "{region}/plan/{agent}", m.Plan, _V, _P),
    Topic("detections", "{region}/detections", m.Detections, _V, _P),
    Topic("lanes", "{region}/lanes/{tls}", m.LaneCounts, _V, _P),
    Topic("metrics", "metrics/{process}", m.Metrics, _W, _T),  # measuring must not load the network
)
"""All topics by name. Liveliness tokens stand at `alive/{role}/{id}` on both buses."""

ALIVE = f"{PREFIX}/alive"
