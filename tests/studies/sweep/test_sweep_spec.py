"""What a study file may contain, and the errors of one that cannot be used."""

from __future__ import annotations

import pytest
import yaml

from protocol.errors import ConfigError
from studies.sweep.study_file import builtin_studies, read_study

GOOD = """
name: small
set: {duration_s: 3}
seeds: [1, 2]
axes:
  traffic.cav_rate: [0, 0.05]
  controller:
    fixed plan: {signal.policy: fixed}
    max pressure: {signal.policy: max_pressure}
"""


OF_CONTROL = {"control", "control_city"}


def refused(tmp_path, text):
    (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_study(str(tmp_path / "own.yaml"))
    assert "own.yaml" in str(caught.value)
    return str(caught.value)


def study(tmp_path, text=GOOD):
    (tmp_path / "own.yaml").write_text(text)
    return read_study(str(tmp_path / "own.yaml")).study


def test_axes_at_the_top_are_one_grid_named_all(tmp_path):
    (grid,) = study(tmp_path).grids
    assert grid.name == "all"
    assert list(grid.axes) == ["traffic.cav_rate", "controller"]


def test_an_unknown_key_is_named_with_those_allowed(tmp_path):
    error_text = refused(tmp_path, GOOD + "sedes: [1]")
    assert "unknown key sedes" in error_text
    assert (
        "a study allows: name, title, scenario, set, seeds, grids, accuracy, page, axes"
        in error_text
    )


def test_an_unknown_key_of_a_grid_is_named_with_its_place(tmp_path):
    error_text = refused(tmp_path, "{name: a, grids: [{name: b, axis: {seed: [1]}}]}")
    assert "unknown key axis in grids.0.axis; a grid allows: name, set, axes" in error_text


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"axes": {"traffic.cav_rate": 5}}, "must be a list of values, or labels"),
        ({"axes": {"traffic.cav_rate": []}}, "must be a list of values, or labels"),
        ({"axes": {"controller": {"a": 1}}}, "must be a list of values, or labels"),
        ({"axes": {"grid": [1]}}, "called grid"),
        ({"axes": {"seed": [1]}}, "called seed"),
        ({"axes": {"own": {"a": {"seed": 1}}}}, "give seeds"),
        ({"axes": {"own": {False: {"seed": 1}}}}, "put it into quotes"),
        ({"axes": {"traffic.cav_rate": [0, 0.0]}}, "each may stand once"),
        ({"axes": {"mode": ["x"], "own": {"a": {"mode": "y"}}}}, "mode and own both set mode"),
        ({"grids": [{"name": "a"}]}, "give axes or grids, not both"),
        ({"set": {"seed": 1}}, "give seeds"),
        ({"seeds": [1, 1]}, "each may stand once"),
        ({"seeds": []}, "at least 1 item"),
        ({"seeds": [-1]}, "seeds.0"),
        ({"name": "a/b"}, "name"),
        ({"accuracy": {"detectors": ["fast"], "moments": 4}}, "is called accuracy.samples now"),
        ({"accuracy": {"detectors": ["fast"], "n": 4}}, "accuracy allows: detectors, samples"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, changed, message):
    assert message in refused(tmp_path, yaml.safe_dump(yaml.safe_load(GOOD) | changed))


def test_two_grids_of_one_name_are_refused(tmp_path):
    assert "each may stand once" in refused(tmp_path, "{name: a, grids: [{name: b}, {name: b}]}")


@pytest.mark.parametrize("text", ["name: [", "- a", "", "5", "\xff: \x00"])
def test_what_is_no_mapping_is_refused(tmp_path, text):
    refused(tmp_path, text)


def test_a_study_that_is_not_there_is_refused_with_those_built_in():
    with pytest.raises(ConfigError, match="neither a file nor one of the built-in .*demo"):
        read_study("nowhere")


def test_settings_of_the_command_win_over_the_file_and_its_grids(tmp_path):
    text = "{name: a, set: {duration_s: 1}, grids: [{name: b, set: {duration_s: 2}}]}"
    changed = study(tmp_path, text).changed({"duration_s": 3}, [7])
    assert changed.settings == {"duration_s": 3}
    assert changed.grids[0].settings == {}
    assert changed.seeds == [7]


def test_a_setting_that_an_axis_varies_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="--set signal.policy: the axis controller varies it"):
        study(tmp_path).changed({"signal.policy": "fixed"}, [])


def test_a_scenario_file_is_looked_for_beside_the_study(tmp_path):
    (tmp_path / "mine.yaml").write_text("name: mine")
    (tmp_path / "own.yaml").write_text(GOOD + "scenario: mine.yaml")
    file = read_study(str(tmp_path / "own.yaml"))
    assert file.scenario == str(tmp_path / "mine.yaml")


def test_built_in_studies_can_be_read():
    assert "demo" in builtin_studies()
    for name in sorted(set(builtin_studies()) - OF_CONTROL):
        assert read_study(name).study.name == name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("axes: {c: {1: {traffic.cv_rate: 1}, '1': {traffic.cv_rate: 0}}}", "may stand once"),
        ("axes: {n: {a: {}, b: {}}}", "a column of its own"),
        ("axes: {delay_s: {a: {}}}", "a column of its own"),
        ("axes: {delay_s_mean: {a: {}}}", "a column of its own"),
        ("axes: {region: {a: {}}}", "a column of its own"),
        ("axes: {mbps_mean: {a: {}}}", "a column of its own"),
        ("axes: {big: {99999999999999999999: {}}}", "put it into quotes"),
        ("axes: {traffic.cv_rate: [1], x: {a: {traffic: {cv_rate: 0}}}}", "both set traffic"),
        ("axes: {traffic.cv_rate: [1]}\nseeds: [1]\nseeds: [2]", "'seeds' stands twice"),
        ("axes: {x: {a: {}, a: {mode: lockstep}}}", "'a' stands twice"),
        ("axes: {x: {a: {}}}\npage: paper", "page: paper needs a grid perception with the axes"),
        ("axes: {x: {a: {}}}\npage: bandwidth", "page: bandwidth needs a grid every-second"),
    ],
)
def test_what_would_mix_up_or_lose_cells_is_refused(tmp_path, change, message):
    path = tmp_path / "own.yaml"
    path.write_text(f"name: own\n{change}\n")
    with pytest.raises(ConfigError, match=message):
        read_study(str(path))


def test_what_is_set_on_the_command_line_wins_over_wholes_and_parts(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("name: own\nset: {traffic.cv_rate: 1}\naxes: {x: {a: {}}}\n")
    study = read_study(str(path)).study.changed({"traffic": {"cv_rate": 0.5}}, [])
    assert study.settings == {"traffic": {"cv_rate": 0.5}}
    path.write_text(
        "name: own\ngrids: [{name: g, set: {link.profile: 5mbit}, axes: {x: {a: {}}}}]\n"
    )
    with pytest.raises(ConfigError, match="grid g sets a whole that holds it"):
        read_study(str(path)).study.changed({"link.profile.rate.mean_mbps": 1}, [])


@pytest.mark.parametrize("name", sorted(set(builtin_studies()) - OF_CONTROL))
def test_the_built_in_studies_can_be_read(name):
    assert read_study(name).study.name == name
