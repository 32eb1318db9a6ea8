"""Which cells a study has, in which order, and what makes one another."""

from __future__ import annotations

import pytest

from protocol.errors import ConfigError
from studies.sweep.cells import cells_of, code_digest, identify
from studies.sweep.study_file import Study, points
from tests.studies.sweep.made_cells import cell

STUDY = Study.model_validate(
    {
        "name": "small",
        "seeds": [2, 1],
        "set": {"a": 0, "b": 0},
        "grids": [
            {"name": "one", "set": {"b": 1}, "axes": {"c": [5, 6], "d": {"x": {"e": 1}, 3: {}}}},
            {"name": "two", "axes": {"c": [5]}},
        ],
    }
)


def resolve(settings):
    return {"mode": "lockstep", **settings}


def test_the_last_axis_changes_first_and_seeds_before_it():
    cells = cells_of(STUDY, resolve)
    shown = [(c.grid, *c.labels.values(), c.seed) for c in cells]
    assert shown == [
        ("one", 5, "x", 2), ("one", 5, "x", 1), ("one", 5, 3, 2), ("one", 5, 3, 1),
        ("one", 6, "x", 2), ("one", 6, "x", 1), ("one", 6, 3, 2), ("one", 6, 3, 1),
        ("two", 5, 2), ("two", 5, 1),
    ]  # fmt: skip


def test_an_axis_wins_over_its_grid_and_that_over_the_study():
    first, *_, last = cells_of(STUDY, resolve)
    assert first.scenario == {"mode": "lockstep", "a": 0, "b": 1, "c": 5, "e": 1, "seed": 2}
    assert last.scenario == {"mode": "lockstep", "a": 0, "b": 0, "c": 5, "seed": 1}


def test_values_stand_in_the_table_as_numbers_or_texts():
    axis = [1, 0.5, "text", True, None, [], {"a": 1}]
    labels = [point.labels["k"] for point in points({"k": axis})]
    assert labels == [1, 0.5, "text", "true", "null", "[]", '{"a": 1}']


def test_a_grid_without_axes_is_one_cell_a_seed():
    study = Study.model_validate({"name": "s", "grids": [{"name": "g"}]})
    assert [c.title for c in cells_of(study, resolve)] == ["g seed=1"]


def test_a_net_that_hides_an_axis_of_networks_is_refused():
    axes = {"city": {"a": {"traffic.network": "grid"}, "b": {"traffic.network": "town"}}}
    study = Study.model_validate({"name": "s", "grids": [{"name": "g", "axes": axes}]})
    with pytest.raises(ConfigError, match=r"g, .*'a'.*: traffic.network has no effect, as traffic"):
        cells_of(study, lambda keys: resolve({**keys, "traffic": {"net": "own.net.xml"}}))
    assert len(cells_of(study, lambda keys: resolve({**keys, "traffic": {"net": None}}))) == 2


def test_a_cell_is_known_by_its_scenario_alone():
    assert identify({"a": 1, "b": 2}) == identify({"b": 2, "a": 1})
    assert identify({"a": 1}) != identify({"a": 2})
    assert cell(1, "one").id == cell(1, "two").id != cell(2, "one").id


def test_other_code_makes_another_cell(monkeypatch):
    before = identify({})
    monkeypatch.setattr("studies.sweep.cells._own_code", lambda: "other")
    assert identify({}) != before


def test_code_is_another_when_a_role_changed_and_not_when_it_was_compiled(tmp_path):
    (tmp_path / "perception" / "__pycache__").mkdir(parents=True)
    source = tmp_path / "perception" / "fusion.py"
    source.write_text("radius_m = 1")
    before = code_digest(tmp_path)
    (tmp_path / "perception" / "__pycache__" / "fusion.pyc").write_text("compiled")
    (tmp_path / "README.md").write_text("changed")
    assert code_digest(tmp_path) == before
    source.write_text("radius_m = 2")
    assert code_digest(tmp_path) != before


def test_another_content_of_a_file_that_a_scenario_names_is_another_cell(tmp_path):
    net = tmp_path / "own.net.xml"
    scenario = {"traffic": {"net": str(net)}}
    net.write_text("one")
    before = identify(scenario)
    assert identify(scenario) == before
    net.write_text("two")
    assert identify(scenario) != before


def test_a_scenario_that_cannot_be_is_named_by_its_cell():
    def refuse(settings):
        raise ConfigError("no such key")

    with pytest.raises(ConfigError, match=r"grid one, \{'c': 5, 'd': 'x'\}: no such key"):
        cells_of(STUDY, refuse)


def test_the_wall_clock_is_refused():
    with pytest.raises(ConfigError, match="must be lockstep"):
        cells_of(STUDY, lambda settings: {"mode": "realtime"})
