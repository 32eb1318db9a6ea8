"""Access control rules allow what the topic table allows, and nothing else."""

from functools import lru_cache

import pytest
import zenoh

from protocol.access import Members, access_control, members_of
from protocol.instances import region_of
from protocol.topics import ALIVE, PRESENCE_WATCHERS, QUERIED, TOPICS, BusName

MEMBERS = members_of({"regions": {"r0": ["J"], "r1": ["K"]}})
EVERYBODY = sorted(
    (name, role)
    for name, role in MEMBERS.roles.items()
    if role != "vehicle" or name in ("vehicle-0", "vehicle-1", "vehicle-63")  # all are made alike
)
PARTS = {"region": "r0", "tls": "J", "agent": "a", "chunk": "0"}
SENDS = {
    "say": [("ingress", "put")],
    "hear": [("ingress", "declare_subscriber"), ("egress", "put")],
}
ASKS = {
    "say": [("ingress", "declare_queryable"), ("ingress", "reply"), ("egress", "query")],
    "hear": [("ingress", "query"), ("egress", "reply")],
}
TOKEN = "liveliness_token"
CONTROLS = {bus: access_control(bus, MEMBERS) for bus in BusName}


@lru_cache
def allowed(bus: BusName, process_id: str, flow: str, message: str) -> list[zenoh.KeyExpr]:
    """Returns the key expressions that a process may use so."""
    control = CONTROLS[bus]
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    subjects = {s["id"] for s in control["subjects"] if process_id in s["cert_common_names"]}
    names = {n for p in control["policies"] if subjects & {*p["subjects"]} for n in p["rules"]}
    return [
        zenoh.KeyExpr(key)
        for rule in control["rules"]
        if rule["id"] in names and flow in rule["flows"] and message in rule["messages"]
        for key in rule["key_exprs"]
        if rule["permission"] == "allow"
    ]


def may(bus: BusName, process_id: str, flow: str, message: str, key: str) -> bool:
    return any(
        mine.includes(zenoh.KeyExpr(key)) for mine in allowed(bus, process_id, flow, message)
    )


@pytest.mark.parametrize("name", TOPICS)
@pytest.mark.parametrize(("process_id", "role"), EVERYBODY)
def test_each_may_say_and_hear_what_the_table_says_and_say_it_under_its_own_id(
    process_id, role, name
):
    topic = TOPICS[name]
    for author, _ in EVERYBODY:
        key = topic.key(process=author, **PARTS)
        own = "{process}" not in topic.template or author == process_id
        # keys of another region: its edge, its signals; only neighbours receive border messages
        foreign = region_of(process_id) not in ("", "r0") and "{" in topic.template
        publishes = own and not (foreign and {"{region}", "{tls}"} & {*topic.template.split("/")})
        subscribes = not (foreign and "{region}" in topic.template and name != "border")
        want = {
            "say": role in topic.publishers and publishes,
            "hear": role in topic.subscribers and subscribes,
        }
        for verb, flows in (ASKS if name in QUERIED else SENDS).items():
            for flow, message in flows:
                assert may(topic.bus, process_id, flow, message, key) == want[verb], (flow, message)
        other = BusName.V2X if topic.bus is BusName.WORLD else BusName.WORLD
        assert not may(other, process_id, "ingress", "put", key)
        assert not may(other, process_id, "egress", "put", key)


@pytest.mark.parametrize("process_id", ["view", "mcap"])
def test_observers_may_ask_for_all_before_they_know_the_region(process_id):
    for topic in TOPICS.values():
        if topic.name not in QUERIED:
            assert may(topic.bus, process_id, "ingress", "declare_subscriber", topic.key())


@pytest.mark.parametrize(("process_id", "role"), EVERYBODY)
def test_nothing_that_one_says_can_be_taken_for_what_it_may_not_say(process_id, role):
    for topic in TOPICS.values():
        if role not in topic.publishers:
            key_expr = zenoh.KeyExpr(topic.key(region="r0", tls="J"))
            allowed_keys = allowed(topic.bus, process_id, "ingress", "put")
            assert not any(key.intersects(key_expr) for key in allowed_keys), topic.name


@pytest.mark.parametrize(("process_id", "role"), EVERYBODY)
def test_each_shows_itself_alone_and_few_see_who_is_there(process_id, role):
    for bus in BusName:
        shown = [str(key) for key in allowed(bus, process_id, "ingress", TOKEN)]
        assert shown == [f"{ALIVE}/{role}/{process_id}"]
        looks = role in PRESENCE_WATCHERS[bus]
        sees = may(bus, process_id, "egress", TOKEN, f"{ALIVE}/vehicle/vehicle-0")
        asks = may(bus, process_id, "ingress", "declare_liveliness_subscriber", f"{ALIVE}/*/*")
        assert (sees, asks) == (looks, looks)


def test_nobody_asks_for_everything():
    for bus in BusName:
        for process_id, _ in EVERYBODY:
            for message in ("declare_subscriber", "query", "liveliness_query", "put", "delete"):
                for key in ("cpnet/v4/**", "**", "@/**"):
                    assert not may(bus, process_id, "ingress", message, key)


def test_whoever_takes_no_part_may_do_nothing():
    for bus in BusName:
        assert access_control(bus, Members({}))["rules"] == []
        assert not allowed(bus, "vehicle-64", "ingress", "put")


def test_no_two_rules_have_one_name():
    for bus in BusName:
        names = [rule["id"] for rule in CONTROLS[bus]["rules"]]
        assert len(set(names)) == len(names)
