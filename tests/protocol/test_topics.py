import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from protocol.errors import MessageError
from protocol.messages import MESSAGES
from protocol.topics import ALIVE, ROLES, TOPICS, BusName, alive_parts


def test_every_message_has_one_topic():
    assert sorted(t.message.kind for t in TOPICS.values()) == sorted(MESSAGES)


def test_every_key_carries_the_protocol_version():
    assert all(topic.key().startswith("cpnet/v4/") for topic in TOPICS.values())


def test_no_ground_truth_travels_on_the_v2x_bus():
    world = {name for name, topic in TOPICS.items() if topic.bus is BusName.WORLD}
    physics = {"setup", "tick", "bodies", "tiles", "truth", "sighting", "trips", "end"}
    measuring = {"progress", "metrics", "time", "clock"}
    assert world == physics | measuring


def test_a_key_gives_its_parts_back():
    topic = TOPICS["scan"]
    parts = {"region": "r0", "process": "vehicle-0", "agent": "main.3", "chunk": "0"}
    assert topic.key(**parts) == "cpnet/v4/r0/scan/vehicle-0/main.3/0"
    assert topic.parts(topic.key(**parts)) == parts


def test_a_part_that_is_left_out_matches_everything():
    assert TOPICS["scan"].key(region="r0") == "cpnet/v4/r0/scan/*/*/*"


@given(st.text(min_size=1))
@example("a/b")
@example("**")
@example("x ?#$%2F")
def test_any_id_can_stand_in_a_key_and_comes_back(agent):
    key = TOPICS["pose"].key(region="r0", process="v", agent=agent)
    assert not set(key.removeprefix("cpnet/v4/r0/pose/v/")) & set("/*$?# ")
    assert TOPICS["pose"].parts(key) == {"region": "r0", "process": "v", "agent": agent}


def test_an_empty_id_cannot_stand_in_a_key():
    with pytest.raises(ValueError, match="empty part"):
        TOPICS["pose"].key(agent="")


def test_everybody_who_speaks_or_hears_has_a_role():
    for topic in TOPICS.values():
        assert topic.publishers
        assert topic.subscribers
        assert topic.publishers | topic.subscribers <= ROLES


def test_whoever_shares_a_topic_with_others_has_a_key_of_its_own():
    shared = {name for name, topic in TOPICS.items() if len(topic.publishers) > 1}
    assert shared - {"sighting"} == {
        name for name, topic in TOPICS.items() if "{process}" in topic.template
    }


@pytest.mark.parametrize("key", ["**", "cpnet/v4/**", "cpnet/v4/r0/pose/*", "cpnet/v4/r0/pose/a"])
def test_what_is_no_key_of_a_topic_has_no_parts(key):
    with pytest.raises(MessageError, match="is no key of topic pose"):
        TOPICS["pose"].parts(key)


def test_a_liveliness_token_tells_role_and_id():
    assert alive_parts(f"{ALIVE}/vehicle/vehicle-0") == ("vehicle", "vehicle-0")


@pytest.mark.parametrize(
    "name",
    [
        f"{ALIVE}/edge/\x1b[2J",
        f"{ALIVE}/a\nb/edge",
        "**",
        f"{ALIVE}/**",
        f"{ALIVE}/*/*",
        f"{ALIVE}/edge/{'x' * 129}",
    ],
)
def test_a_token_that_no_process_declares_is_refused(name):
    with pytest.raises(MessageError, match="liveliness"):
        alive_parts(name)
