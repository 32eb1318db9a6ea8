import pytest
import yaml

from cpnet import scenario as scenarios
from cpnet.scenario import Scenario, load, parse_assignment
from protocol.config import Section
from protocol.errors import ConfigError
from sensing.link_profile import VaryingRate
from signal_controller.config import SignalConfig


def sections(model: type[Section]) -> list[type[Section]]:
    found = [model]
    for field in model.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            found += sections(field.annotation)
    return found


def test_the_built_in_scenario_is_valid_and_complete_without_a_file():
    assert load("t_junction", {}) == Scenario(signal=SignalConfig(policy="max_pressure"))


def test_what_the_command_prints_can_be_read_again(tmp_path):
    scenario = load("t_junction", {"seed": 7, "traffic.cav_rate": 0.2})
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(scenario.model_dump(mode="json")))
    assert load(str(file), {}) == scenario


@pytest.mark.parametrize("section", sections(Scenario), ids=lambda s: s.__name__)
def test_every_key_is_documented(section):
    for name, field in section.model_fields.items():
        is_section = isinstance(field.annotation, type) and issubclass(field.annotation, Section)
        assert field.description or is_section, f"{section.__name__}.{name}"


def test_an_unknown_key_is_refused_with_those_that_are_allowed():
    with pytest.raises(
        ConfigError, match=r"traffic\.cav_rat; did you mean cav_rate\? section.*cv_rate"
    ):
        load("t_junction", {"traffic.cav_rat": 0.1})
    with pytest.raises(ConfigError, match="key colour; a scenario allows: name, seed, mode"):
        load("t_junction", {"colour": "red"})


def test_a_value_out_of_range_is_refused_with_its_key():
    with pytest.raises(ConfigError, match=r"traffic\.cav_rate: .*less than or equal to 1.*got 7"):
        load("t_junction", {"traffic.cav_rate": 7})


def test_an_unknown_scenario_is_refused_with_the_built_in_ones():
    with pytest.raises(
        ConfigError, match="no scenario 'x_junction'.*built-in corridor, grid, t_junction"
    ):
        load("x_junction", {})


@pytest.mark.parametrize("text", ["a: [", "- 1\n- 2", "\x00"])
def test_a_file_that_is_no_scenario_is_refused_with_its_name(tmp_path, text):
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"broken\.yaml"):
        load(str(file), {})


def test_a_frame_that_is_no_multiple_of_the_step_is_refused():
    with pytest.raises(ConfigError, match="multiple of traffic.step_s"):
        load("t_junction", {"frame_period_s": 0.25})


def test_assignments_carry_yaml_values():
    assert parse_assignment("traffic.cav_rate=0.1") == ("traffic.cav_rate", 0.1)
    assert parse_assignment("edge.ground.tile_m=null") == ("edge.ground.tile_m", None)
    for text in ("no-equals", "=1", "a=[1"):
        with pytest.raises(ConfigError, match="--set"):
            parse_assignment(text)


def test_a_key_may_name_an_edge_whose_id_holds_a_dot():
    scenario = load("t_junction", {"traffic.demand_vph_per_lane.a.b": 100})
    assert scenario.traffic.demand_vph_per_lane == {"a.b": 100}


def test_a_list_item_with_a_wrong_key_is_named():
    with pytest.raises(ConfigError, match=r"roadside_mounts\.0\.hight_m; did you mean height_m"):
        load("t_junction", {"roadside_mounts": [{"hight_m": 3}]})


def test_the_name_of_each_built_in_file_is_its_scenarios_name():
    for name in scenarios.builtin_names():
        assert load(name, {}).name == name


def test_a_link_is_kept_in_full_so_that_other_machines_need_no_file(tmp_path):
    trace = tmp_path / "city.up"
    trace.write_text("1\n2\n4\n")
    data = load("t_junction", {"link.profile": str(trace)}).model_dump(mode="json")
    trace.unlink()
    again = scenarios.validate(data, "again")
    assert again.link.profile is not None
    assert again.link.profile.rate.period_us == 4000


def test_a_link_that_does_not_fit_the_mode_is_refused():
    asked = {"link.profile": "lte", "link.apply": "emulated"}
    with pytest.raises(ConfigError, match="in mode lockstep links can only be virtual"):
        load("t_junction", asked)


def test_an_unknown_key_in_a_link_is_named_with_those_allowed():
    rate = {"kind": "varying", "mean": 5}
    with pytest.raises(ConfigError, match="allows: kind, mean_mbps, variation"):
        load("t_junction", {"link.profile": {"rate": rate}})


def test_a_value_of_a_link_can_be_laid_over_one_given_by_its_values(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("link: {profile: {name: mine, rtt: {median_ms: 5, p95_ms: 6, p99_ms: 7}}}")
    profile = load(str(file), {"link.profile.rate.mean_mbps": 5}).link.profile
    assert profile is not None
    assert (profile.name, profile.rtt.p99_ms) == ("mine", 7)
    assert profile.rate == VaryingRate(mean_mbps=5)


def test_a_value_of_a_link_can_be_laid_over_none():
    empty = {"link.profile": None, "link.profile.rate.mean_mbps": 5}
    profile = load("t_junction", empty).link.profile
    assert profile is not None
    assert profile.rate == VaryingRate(mean_mbps=5)


def test_a_value_of_a_link_given_by_its_name_has_no_place():
    named = {"link.profile": "lte", "link.profile.rate.mean_mbps": 5}
    with pytest.raises(ConfigError, match="profile is 'lte', which has no keys of its own"):
        load("t_junction", named)


@pytest.fixture
def renamed_keys(monkeypatch):
    table = {"edge.old_section": "edge.misbehaviour", "roadside_mounts.old_m": "height_m"}
    monkeypatch.setattr(scenarios, "RENAMED_KEYS", table)


@pytest.mark.parametrize("key", ["edge.old_section", "edge.old_section.limit_m"])
def test_a_key_that_was_renamed_is_refused_with_its_new_name(renamed_keys, key):
    with pytest.raises(ConfigError, match=r"edge\.old_section is now edge\.misbehaviour"):
        load("t_junction", {key: 1})


def test_a_renamed_key_is_found_in_a_file_and_in_the_entries_of_a_list(renamed_keys, tmp_path):
    file = tmp_path / "old.yaml"
    file.write_text("edge: {old_section: {}}\nroadside_mounts: [{id: a}, {old_m: 3}]\n")
    with pytest.raises(
        ConfigError, match=r"old\.yaml: renamed key: edge\.old_section (.|\n)*old_m"
    ):
        load(str(file), {})


def keys_of(model: type[Section], path: str = "") -> set[str]:
    found = {path + name for name in model.model_fields}
    for name, field in model.model_fields.items():
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, Section):
                found |= keys_of(kind, f"{path}{name}.")
    return found


def test_each_renamed_key_is_gone_and_its_new_name_is_a_key_of_today():
    today = keys_of(Scenario)
    assert not today & scenarios.RENAMED_KEYS.keys()
    assert today >= set(scenarios.RENAMED_KEYS.values())


def test_pressure_by_queues_needs_tracks_which_know_who_stands_still():
    queued = {"signal.weight": "queued"}
    assert load("t_junction", queued).signal.weight == "queued"
    untracked = {"edge.tracking.enabled": False}
    with pytest.raises(ConfigError, match=r"signal\.weight is queued.* edge\.tracking\.enabled"):
        load("t_junction", queued | untracked)
    assert load("t_junction", queued | untracked | {"signal.policy": "predictive"})


def test_speed_advice_needs_a_policy_that_plans_ahead_and_a_cabinet_that_is_asked():
    advising = {"signal.speed_advice": True}
    with pytest.raises(ConfigError, match="signal: speed_advice needs policy predictive.*max_pres"):
        load("t_junction", advising)
    predictive = advising | {"signal.policy": "predictive"}
    assert load("t_junction", predictive).signal.speed_advice
    with pytest.raises(ConfigError, match="speed_advice.* cabinet.control is actuated"):
        load("t_junction", predictive | {"cabinet.control": "actuated"})
