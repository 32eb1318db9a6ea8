import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from protocol.messages import MESSAGES
from protocol.topics import TOPICS, BusName


def test_every_message_has_one_topic():
    assert sorted(t.message.kind for t in TOPICS.values()) == sorted(MESSAGES)


def test_every_key_carries_the_protocol_version():
    assert all(topic.key().startswith("cpnet/v1/") for topic in TOPICS.values())


def test_no_ground_truth_travels_on_the_v2x_bus():
    world = {name for name, topic in TOPICS.items() if topic.bus is BusName.WORLD}
    physics = {"setup", "tick", "truth", "sighting", "trips", "end"}
    measuring = {"progress", "metrics", "time", "clock"}
    assert world == physics | measuring


def test_a_key_gives_its_parts_back():
    topic = TOPICS["scan"]
    parts = {"region": "r0", "agent": "main.3", "chunk": "0"}
    assert topic.key(**parts) == "cpnet/v1/r0/scan/main.3/0"
    assert topic.parts(topic.key(**parts)) == parts


def test_a_part_that_is_left_out_matches_everything():
    assert TOPICS["scan"].key(region="r0") == "cpnet/v1/r0/scan/*/*"


@given(st.text(min_size=1))
@example("a/b")
@example("**")
@example("x ?#$%2F")
def test_any_id_can_stand_in_a_key_and_comes_back(agent):
    key = TOPICS["pose"].key(region="r0", agent=agent)
    assert not set(key.removeprefix("cpnet/v1/r0/pose/")) & set("/*$?# ")
    assert TOPICS["pose"].parts(key) == {"region": "r0", "agent": agent}


def test_an_empty_id_cannot_stand_in_a_key():
    with pytest.raises(ValueError, match="empty part"):
        TOPICS["pose"].key(agent="")
