"""Presence on a bus where any process may announce itself."""

from cpnet.limits import MAX_UNEXPECTED
from cpnet.scenario import Scenario
from cpnet.watch import PresenceTable, all_processes
from protocol.inbox import Presence

EDGE, SIM = ("edge", "edge"), ("sim", "sim")


def test_ghosts_that_come_and_go_hide_nobody_and_leave_nothing():
    presence_table = PresenceTable([EDGE, SIM])
    for n in range(4000):
        for alive in (True, False):
            presence_table.update(Presence("vehicle", f"ghost-{n}", alive))
    presence_table.update(Presence("vehicle", "vehicle-9", alive=True))
    assert (presence_table.present, presence_table.left) == ({("vehicle", "vehicle-9")}, set())


def test_whoever_is_expected_is_seen_among_any_number_of_strangers():
    presence_table = PresenceTable([EDGE, SIM])
    for n in range(4000):
        presence_table.update(Presence("vehicle", f"ghost-{n}", alive=True))
    for alive in (True, False):
        presence_table.update(Presence("edge", "edge", alive))
    presence_table.update(Presence("sim", "sim", alive=True))
    assert len(presence_table.present) == MAX_UNEXPECTED + 1
    assert SIM in presence_table.present
    assert presence_table.left == {EDGE}


def test_a_stranger_under_an_expected_id_is_not_the_one_who_is_missed():
    presence_table = PresenceTable([EDGE])
    for alive in (True, False):
        presence_table.update(Presence("ghost", "edge", alive))
    assert not presence_table.left


def test_everybody_is_a_role_and_an_id():
    scenario = Scenario.model_validate(
        {
            "processes": {"vehicle": 2},
            "regions": {"r0": ["J"]},
            "roadside_mounts": [{"id": "a", "tls": "J"}],
            "record": {"mcap": True},
        }
    )
    assert all_processes(scenario) == {
        ("router", "router"), SIM, ("record", "record"), ("mcap", "mcap"),
        ("edge", "edge-r0"), ("signal", "signal-r0"),
        ("infra", "infra-r0"), ("vehicle", "vehicle-0"), ("vehicle", "vehicle-1"),
    }  # fmt: skip
