"""`cpnet study control`: its file, its pairs, its table; runs that are kept."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from studies import control_study
from studies.control_baselines import OWN_SETTINGS, TUNINGS, Tuning, worth_trying
from studies.control_case import ControlCase
from studies.control_file import MOST_MIN_GREEN_S, ControlStudy, read_control_study
from studies.control_page import control_page
from studies.control_study import Group, PolicyResult, paired, summaries
from studies.perceived_study import perceived_cases
from studies.sweep.study_file import path_of
from tests.signal_controller.crossing import SITE

STUDY = ControlStudy(
    name="own",
    nets={"t_junction": [1.0, 1.2]},
    policies=["max_pressure", "predictive"],
    seeds=[1, 2],
)


def result(policy: str, *delays_s: float, demand: float = 1.0) -> PolicyResult:
    rest = {"delay_p95_s": 30.0, "waited_s": 60.0, "arrived": 90, "vehicles": 100}
    rest |= {"stops": 1.2, "co2_g": 150.0}
    rows = [{"delay_s": delay_s, "decide_p99_ms": 1.0, **rest} for delay_s in delays_s]
    return PolicyResult(policy, rows, Group("t_junction", demand), None)


def test_the_built_in_study_is_of_its_kind_and_others_are_not() -> None:
    found = read_control_study(path_of("control"), {"seeds": [7]})
    assert found is not None
    assert found.seeds == [7]
    assert read_control_study(path_of("paper"), {}) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": [101]}, "seed 101 is for tuning and reported"),
        ({"studied": "webster2"}, "studied is webster2"),
        ({"perceived": {"webster": {}}}, "webster is of policies and of perceived"),
        ({"nets": {"resco/cologne1": [1.2]}}, "has a demand of its own"),
        ({"edge.detector": "fast"}, "--set edge.detector: a study of control allows: bench"),
        ({"duration_s": 3}, "duration_s"),
        (
            {"cabinet": {"yellow_s": 60}},
            r"study control: cabinet\.yellow_s: .* less than or equal to 20",
        ),
        ({"cabinet": {"max_green_s": 60}}, "cabinet.max_green_s"),
        ({"cabinet": {"min_green_s": 26}}, "cabinet.min_green_s: must be at most 25"),
    ],
)
def test_what_makes_no_study_is_refused(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_control_study(path_of("control"), change)


def test_pairs_tell_what_means_alone_do_not() -> None:
    found = paired([8.0, 18.0, 28.0], [9.0, 19.1, 29.0])
    assert found.mean == pytest.approx(-1.0333, abs=1e-3)
    assert found.half == pytest.approx(0.143, abs=1e-2)
    assert paired([8.0], [9.0]).half is None


def test_a_table_has_the_best_first_and_what_the_studied_policy_takes_off_others() -> None:
    rows = summaries(STUDY, [result("max_pressure", 10.0, 12.0), result("predictive", 8.0, 9.0)])
    page = control_page(STUDY, rows, "cpnet study own", {})
    (table,) = page.sections[0].blocks
    assert [row[0] for row in table.rows] == ["predictive", "max_pressure"]
    assert table.rows[1][5:7] == (1.2, 150.0)
    assert table.rows[1][8].startswith("-2.50 ± ")
    assert table.rows[0][8] is None


SEEN = {"signal.policy": "predictive", "traffic.cav_rate": 0.05}


def perceiving(keys: dict) -> ControlStudy:
    return STUDY.model_copy(update={"perceived": {"on posts": keys}, "studied": "on posts"})


def settings_of(study: ControlStudy, folder: Path) -> list[dict]:
    found: list[dict] = []
    perceived_cases(study, folder, lambda keys: found.append(keys) or keys)
    return found


def test_controls_with_perception_have_posts_and_the_traffic_of_their_net_and_demand(
    tmp_path: Path,
) -> None:
    found = settings_of(perceiving(SEEN), tmp_path)
    assert [one["seed"] for one in found] == [1, 2, 1, 2]
    assert len({one["traffic.sumocfg"] for one in found}) == 2
    for one in found:
        assert len(one["roadside_mounts"]) == 1
        assert one["traffic.cav_rate"] == 0.05
        assert Path(one["traffic.sumocfg"]).exists()
    bare = settings_of(perceiving({**SEEN, "roadside_mounts": []}), tmp_path)
    assert all(one["roadside_mounts"] == [] for one in bare)


def test_the_times_of_the_cabinet_are_those_of_all_controls(tmp_path: Path) -> None:
    study = perceiving(SEEN).model_copy(update={"cabinet": {"yellow_s": 3.0, "all_red_s": 2.0}})
    for one in settings_of(study, tmp_path):
        assert (one["cabinet.yellow_s"], one["cabinet.all_red_s"]) == (3.0, 2.0)
    case = control_study._case(study, Group("t_junction", 1.0), "actuated", {}, None, 1)
    longest = case.tuned(Tuning("", cabinet={"max_green_s": 25}))
    assert longest.cabinet == {"yellow_s": 3.0, "all_red_s": 2.0, "max_green_s": 25}


@pytest.mark.parametrize("key", ["seed", "traffic.step_s", "cabinet.all_red_s", "mode"])
def test_what_would_not_be_the_same_for_all_controls_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(ConfigError, match=f"perceived.on posts: {key} is the same for all"):
        settings_of(perceiving({key: 2}), tmp_path)


def test_what_a_control_with_perception_saw_stands_beside_its_delay() -> None:
    seen = result("on posts", 8.0, 9.0)
    rows = [{**row, "e_cvpr": 0.9, "uplink_mbps": 1.5} for row in seen.rows]
    for row in rows:
        del row["decide_p99_ms"]
    study = perceiving(SEEN)
    found = [result("max_pressure", 10.0, 12.0), replace(seen, rows=rows)]
    (table,) = control_page(study, summaries(study, found), "", {}).sections[0].blocks
    assert table.rows[0][0] == "on posts"
    assert table.rows[0][10:] == (pytest.approx(90), 1.5)
    assert table.rows[1][10:] == (None, None)


def test_every_setting_that_is_tried_is_one_of_its_baseline() -> None:
    for policy, tunings in TUNINGS.items():
        for tuning in tunings:
            assert set(tuning.own) <= set(OWN_SETTINGS[policy])
            assert tuning.cabinet.get("max_green_s", MOST_MIN_GREEN_S) >= MOST_MIN_GREEN_S


def test_compatible_phases_are_tried_where_there_are_any() -> None:
    tunings = TUNINGS["max_pressure"]
    plain = [one for one in tunings if not one.settings]
    assert worth_trying(tunings, SITE.road_map) == plain  # its plan has them all
    [one] = SITE.road_map.intersections
    fewer = one.model_copy(
        update={"signal": one.signal.model_copy(update={"plan": one.signal.plan[:8]})}
    )
    roads = SITE.road_map.model_copy(update={"intersections": [fewer]})
    assert worth_trying(tunings, roads) == list(tunings)
    assert len(tunings) == 2 * len(plain)


class ShortAndLong:
    """Runs in which another tuning is best than in shorter ones."""

    def __init__(self) -> None:
        self.durations_s: list[int] = []

    def run(self, work, cases, processes, report):
        self.durations_s += [one.case.duration_s for one in cases]
        order = {30.0: (1, 3), 50.0: (2, 2), 100.0: (3, 1), 200.0: (4, 0)}
        return [
            {"delay_s": order[one.case.upstream_m][one.case.duration_s == 3600]} for one in cases
        ]


@pytest.mark.parametrize(("finalists", "upstream_m", "runs"), [(3, 100.0, 7), (1, 30.0, 4)])
def test_the_best_of_short_runs_are_tried_again_in_long_ones(
    monkeypatch, finalists, upstream_m, runs
) -> None:
    monkeypatch.setattr(control_study, "_roads", lambda study, group: SITE.road_map)
    study = STUDY.model_copy(update={"finalists": finalists, "tuning_seeds": [101]})
    store, group = ShortAndLong(), Group("t_junction", 1.0)
    fences = [Tuning("", upstream_m=m, downstream_m=0) for m in (200.0, 30.0, 100.0, 50.0)]
    tried = {"max_pressure": fences}
    found = control_study._tuned(study, [group], {}, store, 1, lambda *_: None, tried)
    assert found[group, "max_pressure"].upstream_m == upstream_m
    assert store.durations_s == [1200] * 4 + [3600] * (runs - 4)


def test_a_case_that_was_run_is_not_run_again(tmp_path: Path) -> None:
    store = control_study.CaseStore(tmp_path)
    case = control_study.BenchCase(ControlCase("t_junction", "plan"))
    store._path("run_row", case).write_text('{"delay_s": 5.0}')
    run = control_study.run_row
    assert store.run(run, [case, case], 1, lambda *_: None) == [{"delay_s": 5.0}] * 2


@pytest.mark.process
def test_a_run_that_fails_ends_the_pool_in_order(tmp_path: Path) -> None:
    """An error in a thread of the pool would fail this test."""
    cases = [control_study.BenchCase(ControlCase("t_junction", "plan", seed)) for seed in range(4)]
    with pytest.raises(TypeError):
        control_study.CaseStore(tmp_path).run(float, cases, 2, lambda *_: None)
    assert not multiprocessing.active_children()
