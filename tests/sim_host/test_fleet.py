"""Vehicles are spread over the processes that live."""

from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import Equipment
from sim_host.journeys import draw_equipment
from sim_host.presence import Fleet

CAV, CV = Equipment.CAV, Equipment.CV


def fleet_of(*processes: str) -> Fleet:
    fleet = Fleet()
    for process in processes:
        fleet.join(process)
    return fleet


def test_newcomers_go_to_the_process_with_the_fewest_ties_by_id() -> None:
    fleet = fleet_of("vehicle-1", "vehicle-0")
    assert fleet.assign({"c": CAV, "a": CAV, "b": CAV}) == {
        "a": "vehicle-0",
        "b": "vehicle-1",
        "c": "vehicle-0",
    }


def test_cheap_cvs_do_not_keep_cavs_away() -> None:
    fleet = fleet_of("vehicle-0", "vehicle-1")
    fleet.assign({"v": CV})
    assert fleet.assign({"v": CV, "w": CAV})["w"] == "vehicle-0"


def test_a_vehicle_stays_where_it_is() -> None:
    fleet = fleet_of("vehicle-0", "vehicle-1")
    before = fleet.assign({"a": CAV, "b": CAV, "c": CAV})
    fleet.join("vehicle-2")
    after = fleet.assign({"b": CAV, "c": CAV, "d": CAV})
    assert {name: after[name] for name in "bc"} == {name: before[name] for name in "bc"}
    assert after["d"] == "vehicle-2"


def test_the_vehicles_of_a_dead_process_move() -> None:
    fleet = fleet_of("vehicle-0", "vehicle-1")
    fleet.assign({"a": CAV, "b": CAV})
    fleet.leave("vehicle-0")
    assert fleet.assign({"a": CAV, "b": CAV}) == {"a": "vehicle-1", "b": "vehicle-1"}
    fleet.leave("vehicle-1")
    assert fleet.assign({"a": CAV, "b": CAV}) == {}


@given(st.integers(1, 6), st.integers(0, 40))
def test_the_load_is_even(processes: int, vehicles: int) -> None:
    fleet = fleet_of(*(f"vehicle-{i}" for i in range(processes)))
    hosts = list(fleet.assign({str(i): CAV for i in range(vehicles)}).values())
    loads = [hosts.count(process) for process in fleet.processes]
    assert sum(loads) == vehicles
    assert max(loads) - min(loads) <= 1


def test_equipment_follows_from_seed_and_id_at_about_the_rate() -> None:
    names = [f"flow.{i}" for i in range(4000)]
    drawn = [draw_equipment(1, name, 0.2, 0.3) for name in names]
    assert drawn == [draw_equipment(1, name, 0.2, 0.3) for name in names]
    assert drawn != [draw_equipment(2, name, 0.2, 0.3) for name in names]
    assert abs(drawn.count(CAV) / 4000 - 0.2) < 0.03
    assert abs(drawn.count(CV) / 4000 - 0.3) < 0.03


def test_a_higher_rate_keeps_the_cavs_of_a_lower_one() -> None:
    names = [f"flow.{i}" for i in range(500)]
    few = {name for name in names if draw_equipment(3, name, 0.05, 0) is CAV}
    more = {name for name in names if draw_equipment(3, name, 0.2, 0) is CAV}
    assert few < more
