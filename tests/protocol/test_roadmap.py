from protocol.roadmap import Link, PlanPhase, Signal

PLAN = [
    PlanPhase(duration_s=40, state="GGr"),
    PlanPhase(duration_s=4, state="yyr"),
    PlanPhase(duration_s=1, state="rrr"),
    PlanPhase(duration_s=20, state="rrG"),
    PlanPhase(duration_s=5, state="rry"),
]


def signal(offset_s: float = 0.0) -> Signal:
    links = [Link(index=i, from_lane=f"in_{i}", to_lane=f"out_{i}") for i in range(3)]
    return Signal(tls="J", links=links, conflicts=[(0, 2), (1, 2)], plan=PLAN, offset_s=offset_s)


def test_the_phases_of_a_plan_are_its_green_states():
    assert signal().greens == ["GGr", "rrG"]


def test_while_the_plan_clears_the_junction_the_next_green_is_planned():
    shown = [signal().planned_green(time_s) for time_s in (0, 39.9, 41, 44.5, 45, 64, 66, 70)]
    assert shown == ["GGr", "GGr", "rrG", "rrG", "rrG", "rrG", "GGr", "GGr"]


def test_an_offset_shifts_the_plan():
    assert signal(offset_s=45).planned_green(45) == "GGr"
    assert signal(offset_s=45).planned_green(30) == "rrG"
