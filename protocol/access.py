"""TLS certificates and access control: which process may publish and subscribe to which topic.

A process is identified by the common name of its certificate, which is its id. The rules, made from
the topic table, become Zenoh's access control; what no row allows is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from protocol.instances import (
    REGION_ROLES,
    ROUTER,
    WORLD_HOST,
    region_instances,
    region_of,
    vehicle_instances,
)
from protocol.topics import (
    ALIVE,
    ALIVE_IN_ANY,
    PRESENCE_WATCHERS,
    QUERIED,
    TOPICS,
    BusName,
)

AUTHORITY = "ca.pem"
"""File name of the CA certificate, against which every process verifies the others."""


@dataclass(frozen=True, slots=True)
class Keys:
    """A process's certificate and private key, and the CA certificate.

    The common name of a certificate is the process's id.
    """

    authority: Path
    certificate: Path
    private_key: Path

    @classmethod
    def of(cls, folder: Path, process_id: str) -> Keys:
        """Returns the paths of this process's key files, as `cpnet keys` names them."""
        key = folder / f"{process_id}.key"
        return cls(folder / AUTHORITY, folder / f"{process_id}.pem", key)

    def settings(self) -> dict[str, object]:
        """Returns Zenoh's settings for links over mutual TLS: both sides present a certificate."""
        return {
            "root_ca_certificate": str(self.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_certificate": str(self.certificate),
            "listen_private_key": str(self.private_key),
            "connect_certificate": str(self.certificate),
            "connect_private_key": str(self.private_key),
        }


MAX_VEHICLE_PROCESSES = 64
"""Vehicle processes that can have keys: `vehicle-0` and on."""

_PUB, _SUB = "publish", "subscribe"
_PUBLISH = {
    _PUB: (("ingress", ["put"]),),
    _SUB: (("ingress", ["declare_subscriber"]), ("egress", ["put"])),
}
_QUERY = {
    _PUB: (("ingress", ["declare_queryable", "reply"]), ("egress", ["query"])),
    _SUB: (("ingress", ["query"]), ("egress", ["declare_queryable", "reply"])),
}
_DECLARE_TOKEN = (("ingress", ["liveliness_token"]),)
_SUBSCRIBE_TOKENS = (
    ("ingress", ["declare_liveliness_subscriber", "liveliness_query"]),
    ("egress", ["liveliness_token"]),
)
Flows = tuple[tuple[str, list[str]], ...]


@dataclass(frozen=True, slots=True)
class Members:
    """The processes of a run: the role of each by its id; the signals by region, if known."""

    roles: dict[str, str]
    regions: Mapping[str, Sequence[str]] | None = None


def members_of(scenario: dict[str, Any]) -> Members:
    """Returns all processes that may take part in a run of this scenario, on whatever machine.

    They include vehicle processes that the scenario does not start with and that may join later.
    """
    return Members(roles_of(MAX_VEHICLE_PROCESSES, scenario["regions"]), scenario["regions"])


def roles_of(vehicles: int, regions: Iterable[str]) -> dict[str, str]:
    """Returns the role of each process of a run with so many vehicle processes, by its id."""
    alone = (ROUTER, WORLD_HOST, "record", "mcap", "view", "watch")
    several = [one for role in REGION_ROLES for one in region_instances(role, regions)]
    several += vehicle_instances(vehicles)
    relays = {f"relay-{kind}": "relay" for kind in ("vehicle", "roadside")}
    return {name: name for name in alone} | {one.id: one.role for one in several} | relays


def access_control(bus: BusName, members: Members) -> dict[str, Any]:
    """Returns the setting `access_control` of the bus's router, for the members of a run."""
    rules, policies = [], []
    for process_id, role in sorted(members.roles.items()):
        mine = list(_rules(bus, process_id, role, members.regions))
        rules += mine
        policies.append({"rules": [rule["id"] for rule in mine], "subjects": [process_id]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in sorted(members.roles)],
        "policies": policies,
    }


def _rules(
    bus: BusName, process_id: str, role: str, regions: Mapping[str, Sequence[str]] | None
) -> Iterable[dict[str, Any]]:
    """Yields what one process may do, one rule for each direction and kind of message.

    A process of a region publishes for that region and its signals alone.
    """
    region = region_of(process_id)
    for topic in TOPICS.values():
        if topic.bus is not bus:
            continue
        for verb, roles in ((_PUB, topic.publishers), (_SUB, topic.subscribers)):
            if role in roles:
                flows = (_QUERY if topic.name in QUERIED else _PUBLISH)[verb]
                own = {"process": process_id} if verb == _PUB else {}
                if region and (verb == _PUB or topic.name != "border"):
                    own["region"] = region
                signals = (regions or {}).get(region) if verb == _PUB else None
                for tls in signals if signals and "{tls}" in topic.template else [None]:
                    key = topic.key(**own, **({} if tls is None else {"tls": tls}))
                    name = f"{process_id}: {verb} {topic.name}" + (f" {tls}" if tls else "")
                    yield from _allow(name, flows, key)
    yield from _allow(
        f"{process_id}: presence", _DECLARE_TOKEN, f"{ALIVE}/{role}/{quote(process_id)}"
    )
    if role in PRESENCE_WATCHERS[bus]:
        yield from _allow(f"{process_id}: watch presence", _SUBSCRIBE_TOKENS, ALIVE_IN_ANY)


def _allow(name: str, flows: Flows, key: str) -> Iterable[dict[str, Any]]:
    for flow, messages in flows:
        yield {
            "id": f"{name}, {flow}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": [key],
        }
