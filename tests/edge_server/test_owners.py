"""Ownership of agents: which process may publish for which agent."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from edge_server.owners import MAX_AGENTS, AgentOwners
from protocol.messages import Roster

AGENTS = st.sampled_from("abcdef")
PROCESSES = st.sampled_from("PQR")


def roster(process: str, *agents: str) -> Roster:
    return Roster(frame=0, process=process, agents=list(agents), scanning=list(agents))


def test_an_agent_goes_on_with_another_process_once_its_own_has_vanished() -> None:
    owners = AgentOwners({}, drops := Counter())
    assert owners.admits("P", "a")
    assert not owners.admits("Q", "a")
    assert owners.own(roster("Q", "a", "b")).agents == ["b"]
    owners.forget("P")
    assert owners.own(roster("Q", "a", "b")).agents == ["a", "b"]
    assert not owners.admits("P", "a")
    assert drops == {"wrong_sender": 3}


def test_an_agent_that_a_roster_leaves_out_is_free() -> None:
    owners = AgentOwners({}, Counter())
    owners.own(roster("P", "a"))
    owners.own(roster("P"))
    assert owners.admits("Q", "a")


def test_a_post_stays_its_processs_own_even_when_that_is_away() -> None:
    owners = AgentOwners({"rsu-0": "infra-0"}, Counter())
    owners.own(roster("infra-0"))
    owners.forget("infra-0")
    assert not owners.admits("P", "rsu-0")
    assert owners.admits("infra-0", "rsu-0")


def test_one_process_cannot_speak_for_all_the_world() -> None:
    owners = AgentOwners({}, drops := Counter())
    taken = sum(owners.admits("P", str(n)) for n in range(MAX_AGENTS + 10))
    assert (taken, drops["too_many_agents"]) == (MAX_AGENTS, 10)


@given(st.lists(st.tuples(PROCESSES, st.lists(AGENTS, unique=True))))
def test_no_agent_is_ever_two_processes(rosters: list[tuple[str, list[str]]]) -> None:
    owners, newest = AgentOwners({}, Counter()), {}
    for process, agents in rosters:
        newest[process] = owners.own(roster(process, *agents)).agents
        held = [agent for one in newest.values() for agent in one]
        assert len(held) == len(set(held))
