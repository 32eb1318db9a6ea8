"""Sender quotas of the inbox: a flooding sender displaces no other's messages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.inbox import Envelope, Inbox, Presence, RawMessage, SenderQuotas
from protocol.limits import MAX_SENDERS, MIN_QUOTA_PER_S
from protocol.messages import AgentPose, Equipment, Roster
from protocol.topics import TOPICS, Topic
from protocol.wire import encode

SECOND_NS = 1_000_000_000


def roster(process: str, frame: int = 1, at_ns: int = 0) -> RawMessage:
    message = Roster(frame=frame, process=process, agents=[], scanning=[])
    key = TOPICS["roster"].key(region="r0", process=process)
    return RawMessage(TOPICS["roster"], key, encode(message), at_ns)


def of(process: str) -> tuple[Topic, str]:
    """A topic that a process signs, and its key."""
    return TOPICS["roster"], TOPICS["roster"].key(region="r0", process=process)


def unsigned(topic: str, at_ns: int = 0, **parts: str) -> RawMessage:
    """An undecoded message whose key names no process."""
    return RawMessage(TOPICS[topic], TOPICS[topic].key(**parts), b"", at_ns)


def pose(process: str, agent: str, at_ns: int = 0) -> RawMessage:
    message = AgentPose(
        frame=1,
        sim_time_ns=1,
        agent=agent,
        equipment=Equipment.CAV,
        pose=[0.0] * 6,
        length_m=4,
        width_m=2,
        height_m=2,
        position_std_m=0.1,
    )
    key = TOPICS["pose"].key(region="r0", process=process, agent=agent)
    return RawMessage(TOPICS["pose"], key, encode(message), at_ns)


def shared(capacity: int = 40, *processes: str, is_paced: bool = False) -> Inbox:
    inbox = Inbox(capacity)
    inbox.set_quotas(is_paced=is_paced)
    for process in processes:
        inbox.put(Presence("vehicle", process, alive=True))
        assert isinstance(inbox.get(), Presence)
    return inbox


def senders(inbox: Inbox) -> list[str]:
    found = []
    while isinstance(item := inbox.get(), Envelope):
        found.append(item.parts["process"])
    return found


def test_a_flood_under_many_agents_names_leaves_two_thirds_to_the_others():
    inbox = shared(60, "bad", "good")
    for number in range(500):
        inbox.put(pose("bad", f"agent-{number}"))
    for number in range(13):
        inbox.put(roster("good", number))
    came = senders(inbox)
    assert came.count("good") == 13
    assert came.count("bad") == 60 // 3
    assert inbox.drops == {"rate_limited": 480}


@pytest.mark.parametrize("count", [1, 4, 12])
def test_where_many_flood_at_once_one_more_has_two_thirds_of_an_equal_share(count: int) -> None:
    inbox = shared(300, "good", *(f"bad-{number}" for number in range(count)))
    for number in range(300):
        for sender in range(count):
            inbox.put(pose(f"bad-{sender}", f"agent-{number}"))
    for number in range(300):
        inbox.put(roster("good", number))
    came = senders(inbox)
    assert came.count("good") >= 2 / 3 * 300 / (count + 2) - 1
    assert len({came.count(f"bad-{number}") for number in range(count)}) <= 2


def test_strangers_are_slowed_down_without_a_clock_too():
    inbox, received = shared(16_384, "good"), 0
    for number in range(10_000):
        inbox.put(roster(f"invented-{number}", at_ns=SECOND_NS + number * SECOND_NS // 10_000))
        received += len(senders(inbox))
    assert received < 3 * MIN_QUOTA_PER_S
    inbox.put(roster("good", at_ns=2 * SECOND_NS))
    assert senders(inbox) == ["good"]


def test_a_flood_under_many_processes_names_has_one_share():
    inbox = shared(60, "good")
    for number in range(500):
        inbox.put(roster(f"invented-{number}"))
    for number in range(13):
        inbox.put(roster("good", number))
    came = senders(inbox)
    assert came.count("good") == 13
    assert len(came) == 13 + 60 // 3


@pytest.mark.parametrize("is_paced", [True, False])
def test_a_flood_of_one_topic_that_no_process_signs_leaves_room_for_another(is_paced: bool) -> None:
    inbox = shared(60, "good", is_paced=is_paced)
    inbox.keep_encoded()
    for number in range(500):
        inbox.put(unsigned("lanes", region="r0", tls=f"invented-{number}"))
    for _ in range(6):
        inbox.put(unsigned("tick"))
        inbox.put(roster("good"))
    came = []
    while isinstance(item := inbox.get(), Envelope):
        came.append(item.topic)
    assert came.count("lanes") == 60 // 3
    assert (came.count("tick"), came.count("roster")) == (6, 6)


def test_what_is_read_makes_room_again():
    inbox = shared(8, "one")
    for _ in range(5):
        for _ in range(4):
            inbox.put(roster("one"))
        assert 2 <= len(senders(inbox)) <= 4
    inbox.put(roster("one"))
    assert senders(inbox) == ["one"]


def test_a_large_message_takes_a_share_of_the_bytes():
    size = len(encode(Roster(frame=1, process="one", agents=[], scanning=[])))
    inbox = Inbox(100, max_bytes=6 * size)
    inbox.set_quotas(is_paced=False)
    inbox.put(Presence("vehicle", "one", alive=True))
    for _ in range(5):
        inbox.put(roster("one"))
    inbox.get()
    assert senders(inbox) == ["one"] * 2


def test_who_sends_too_fast_is_not_heard_until_it_has_made_up_for_it():
    inbox = shared(16_384, "fast", "slow", is_paced=True)
    now_ns, received = SECOND_NS, 0
    for number in range(20_000):
        now_ns = SECOND_NS + number * SECOND_NS // 10_000
        inbox.put(roster("fast", at_ns=now_ns))
        if number % 1000 == 0:
            inbox.put(roster("slow", at_ns=now_ns))
            came = senders(inbox)
            received += came.count("fast")
            assert came.count("slow") == 1
    assert received < 3 * MIN_QUOTA_PER_S
    assert inbox.flooding(now_ns) == {"fast"}
    assert inbox.flooding(now_ns + 2 * SECOND_NS) == set()
    inbox.put(roster("fast", at_ns=now_ns + 2 * SECOND_NS))
    assert senders(inbox) == ["fast"]


def test_without_a_clock_nobody_is_too_fast():
    inbox = shared(16_384, "fast")
    for _ in range(50):
        for _ in range(100):
            inbox.put(roster("fast"))
        assert len(senders(inbox)) == 100
    assert inbox.flooding(0) == set()
    assert not inbox.drops


@given(st.lists(st.tuples(st.sampled_from("abcde"), st.integers(1, 9), st.booleans()), max_size=90))
def test_shares_never_exceed_the_whole(steps: list[tuple[str, int, bool]]) -> None:
    shares, held = SenderQuotas(12, 60, is_paced=False), dict.fromkeys([*"abcde", ""], 0)
    sizes: dict[str, list[int]] = {name: [] for name in held}
    for process in "abc":
        shares.show(process, alive=True)
    for process, size, is_read in steps:
        sender = shares.sender_of(*of(process))
        if is_read and sizes[sender]:
            shares.add(sender, (-1, -sizes[sender].pop()))
        elif shares.has_room(sender, (1, size)):
            shares.add(sender, (1, size))
            sizes[sender].append(size)
    assert sum(len(waiting) for waiting in sizes.values()) <= 12
    assert sum(sum(waiting) for waiting in sizes.values()) <= 60


@pytest.mark.parametrize("count", [MAX_SENDERS + 10])
def test_only_so_many_have_a_share_of_their_own(count: int) -> None:
    shares = SenderQuotas(1000, 1000, is_paced=False)
    for number in range(count):
        shares.show(f"p{number}", alive=True)
    assert shares.sender_of(*of("p0")) == "p0"
    assert shares.sender_of(*of(f"p{count - 1}")) == ""


def test_who_shows_itself_late_keeps_what_waits_and_leaves_nothing_behind():
    inbox = Inbox(40)
    inbox.set_quotas(is_paced=False)
    inbox.limit("roster", 2)
    for frame in range(2):
        inbox.put(roster("late", frame))
    inbox.put(Presence("vehicle", "late", alive=True))
    for frame in range(2, 6):
        inbox.put(roster("late", frame))
    assert senders(inbox) == ["late"] * 2
    inbox.get()
    inbox.put(Presence("vehicle", "late", alive=False))
    inbox.get()
    shares = inbox._quotas
    assert shares is not None
    left = {name: (one.messages, one.size_bytes) for name, one in shares._senders.items()}
    assert left == {"": (0, 0)}  # that of unknown senders
