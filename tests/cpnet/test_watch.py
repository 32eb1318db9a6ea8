"""Who is seen on a bus where anybody may say to be there."""

from cpnet.scenario import Scenario
from cpnet.watch import MAX_UNEXPECTED, PresenceTable, all_processes
from protocol.inbox import Presence

EDGE, SIM = ("edge", "edge"), ("sim", "sim")


def test_ghosts_that_come_and_go_hide_nobody_and_leave_nothing():
    crowd = PresenceTable([EDGE, SIM])
    for n in range(4000):
        for alive in (True, False):
            crowd.hear(Presence("vehicle", f"ghost-{n}", alive))
    crowd.hear(Presence("vehicle", "vehicle-9", alive=True))
    assert (crowd.present, crowd.left) == ({("vehicle", "vehicle-9")}, set())


def test_whoever_is_expected_is_seen_among_any_number_of_strangers():
    crowd = PresenceTable([EDGE, SIM])
    for n in range(4000):
        crowd.hear(Presence("vehicle", f"ghost-{n}", alive=True))
    for alive in (True, False):
        crowd.hear(Presence("edge", "edge", alive))
    crowd.hear(Presence("sim", "sim", alive=True))
    assert len(crowd.present) == MAX_UNEXPECTED + 1
    assert SIM in crowd.present
    assert crowd.left == {EDGE}


def test_a_stranger_under_an_expected_id_is_not_the_one_who_is_missed():
    crowd = PresenceTable([EDGE])
    for alive in (True, False):
        crowd.hear(Presence("ghost", "edge", alive))
    assert not crowd.left


def test_everybody_is_a_role_and_an_id():
    scenario = Scenario.model_validate(
        {"processes": {"vehicle": 2}, "roadside_mounts": [{"id": "a"}], "record": {"tape": True}}
    )
    assert all_processes(scenario) == {
        EDGE, SIM, ("signal", "signal"), ("record", "record"), ("tape", "tape"),
        ("infra", "infra-0"), ("vehicle", "vehicle-0"), ("vehicle", "vehicle-1"),
    }  # fmt: skip
