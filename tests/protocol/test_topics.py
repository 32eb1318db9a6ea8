import pytest

from protocol.messages import MESSAGES
from protocol.topics import TOPICS, BusName


def test_every_message_has_one_topic():
    assert sorted(t.message.kind for t in TOPICS.values()) == sorted(MESSAGES)


def test_every_key_carries_the_protocol_version():
    assert all(topic.key().startswith("cpnet/v1/") for topic in TOPICS.values())


def test_no_ground_truth_travels_on_the_v2x_bus():
    world = {name for name, topic in TOPICS.items() if topic.bus is BusName.WORLD}
    physics = {"setup", "tick", "truth", "trips", "end"}
    measuring = {"progress", "metrics", "time", "clock"}
    assert world == physics | measuring


def test_a_key_gives_its_parts_back():
    topic = TOPICS["scan"]
    parts = {"region": "r0", "agent": "main.3", "chunk": "0"}
    assert topic.key(**parts) == "cpnet/v1/r0/scan/main.3/0"
    assert topic.parts(topic.key(**parts)) == parts


def test_a_part_that_is_left_out_matches_everything():
    assert TOPICS["scan"].key(region="r0") == "cpnet/v1/r0/scan/*/*"


@pytest.mark.parametrize("agent", ["a/b", "**", "", "a b", "x?y", "#"])
def test_a_part_that_would_break_the_key_is_refused(agent):
    with pytest.raises(ValueError, match="cannot stand in the key"):
        TOPICS["pose"].key(agent=agent)
