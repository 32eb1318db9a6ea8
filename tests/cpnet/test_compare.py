"""`cpnet compare`, by the commands of docs/own-junction.md, and what it refuses."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cpnet.study_cells import resolved
from protocol.errors import ConfigError
from studies.compare import Variant, _baselines, perceived_cases
from studies.compare_answer import answer, caveat
from studies.compare_page import compare_page, seen_table
from studies.compare_question import Question, prepare
from studies.control_baselines import TUNINGS
from studies.control_case import ControlCase
from studies.control_study import BenchCase, CaseStore, run_flows
from studies.sumo_config import write_config

pytest.importorskip("polars", reason="needs the extra `study`")

PAGE = Path(__file__).parents[2] / "docs" / "own-junction.md"


def resolve(settings):
    return resolved("t_junction", settings)


@pytest.fixture(scope="module")
def net(tmp_path_factory) -> Path:
    """Draws the junction of the tutorial by the tutorial's own files and command."""
    folder, text = tmp_path_factory.mktemp("own"), PAGE.read_text("utf-8")
    blocks = re.findall(r"```xml\n(.*?)```", text, re.DOTALL)
    for name, block in zip(("nod", "edg", "tll", "rou"), blocks, strict=True):
        (folder / f"mine.{name}.xml").write_text(block)
    (command,) = re.findall(r"```\n(netconvert .*)\n```", text)
    netconvert(command, folder)
    return folder / "mine.net.xml"


def netconvert(command: str, folder: Path) -> None:
    words = [str(Path(sys.executable).parent / "netconvert"), *command.split()[1:]]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)


def test_the_tutorials_timing_and_turning_counts_are_what_is_compared(net, tmp_path) -> None:
    folder, text = tmp_path / "timed", PAGE.read_text("utf-8")
    shutil.copytree(net.parent, folder)
    (command,) = re.findall(r"```text\n(netconvert .*--tllogic-files .*)\n```", text)
    netconvert(command, folder)
    routes = folder / "mine.rou.xml"
    question = Question(net=folder / net.name, routes=routes)
    comparison = prepare(question, tmp_path, "mine", resolve)
    (junction,) = comparison.road_map.intersections
    assert [one.duration_s for one in junction.signal.plan if one.is_green] == [35, 25]
    edges = {one.get("id") for one in ElementTree.parse(net).iter("edge")}
    flows = list(ElementTree.parse(routes).iter("flow"))
    assert {one.get(end) for one in flows for end in ("from", "to")} <= edges
    assert str(routes) in comparison.config.read_text("utf-8")


def test_the_tutorials_net_has_no_turns_back(net) -> None:
    turns = [one.get("dir") for one in ElementTree.parse(net).iter("connection") if one.get("tl")]
    assert len(turns) == 16
    assert "t" not in turns


@pytest.mark.slow
@pytest.mark.process
def test_the_tutorials_command_gives_a_sentence_and_a_page(net, shell) -> None:
    (command,) = re.findall(r"```\ncpnet (compare .*)\n```", PAGE.read_text("utf-8"))
    words = [str(net) if word == net.name else word for word in command.split()]
    short = ["--duration=60", "--warmup=0", "--tuning=0", "--seeds=1", "--cav-rate=0"]
    status, printed = shell.run(*words, *short, "--out=answer", "--jobs=1")
    assert status == 0, printed
    assert "With 1 roadside post and predictive control a vehicle loses" in " ".join(
        printed.split()
    )
    page = (shell.folder / "answer" / "report.html").read_text("utf-8")
    for title in ("By approach", "Queues over time", "What was seen", "How it was made"):
        assert title in page


@pytest.mark.slow
@pytest.mark.process
def test_an_interruption_keeps_what_is_done_and_says_so(net, shell) -> None:
    words = ["compare", f"--net={net}", "--demand=300", "--tuning=60", "--seeds=1", "--out=answer"]
    command = shell.start(*words)
    command.read_until("tuning 1/46")  # 12 of them with compatible phases
    command.process.send_signal(signal.SIGINT)
    status, printed = command.finish()
    assert status == 130
    assert "finished runs are kept: the same command goes on with the rest" in printed
    assert "Traceback" not in printed
    assert [*(shell.folder / "answer" / "cases").glob("*.json")]


def variant(policy: str, sight: str, delay_s: float, east_s: float = 20.0) -> Variant:
    row = {
        "delay_s": delay_s,
        "delay_p95_s": 60.0,
        "vehicles": 122,
        "arrived": 78,
        "approaches": {"from east": east_s},
        "queues": [1.0, None],
    }
    if sight in ("posts", "CAVs", "posts and CAVs"):
        row |= {"uplink_mbps": 0.3, "uplink_peak_mbps": 0.4, "scan_kb": 38.0, "scan_peak_kb": 42.0}
    return Variant(policy, [row], sight, "")


@pytest.fixture
def posts_only(net, tmp_path):
    question = Question(
        net=net, demand_vph=300.0, cav_rate=0.0, seeds=(1,), duration_s=60, tuning_s=0
    )
    return prepare(question, tmp_path, "mine", resolve)


VARIANTS = [
    variant("plan", "", 22.0),
    variant("webster", "", 23.0),
    variant("actuated", "", 21.0),
    variant("max_pressure", "posts", 19.0),
    variant("predictive", "posts", 20.0, east_s=23.4),
]


def test_the_sentence_says_what_a_link_needs_not_only_what_is_sent_on_average(posts_only) -> None:
    text = answer(posts_only, VARIANTS)
    assert "send 0.3 Mbit/s on average, 0.4 Mbit/s at most" in text
    assert "needs 3.4 Mbit/s for its largest scan (42 kB) to be there within 100 ms" in text
    assert "0.3 Mbit/s for within the frame period" in text
    assert seen_table(posts_only, VARIANTS).rows[1][-3:] == pytest.approx((42.0, 3.36, 0.336))


def test_the_sentence_owns_up_to_short_runs_and_to_who_loses(posts_only) -> None:
    text = answer(posts_only, VARIANTS)
    assert text.startswith("A direction only: 1 seed of 60 s, baselines not tuned. With 1 roadside")
    assert text.endswith("within 300 m of the stop bar from east (3.4 s).")
    assert "loses more" not in answer(
        posts_only, [*VARIANTS[:4], variant("predictive", "posts", 20.0)]
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"seeds": range(5)}, ""),
        ({"seeds": (1, 2, 3)}, "A direction only: 3 seeds of 600 s."),
        ({"seeds": range(5), "duration_s": 599}, "A direction only: 5 seeds of 599 s."),
        ({"seeds": range(5), "tuning_s": 0}, "5 seeds of 600 s, baselines not tuned."),
    ],
)
def test_five_long_and_tuned_seeds_are_more_than_a_direction(options, text) -> None:
    assert caveat(Question(**options), 900).endswith(text)
    assert bool(caveat(Question(**options), 900)) == bool(text)


def test_an_answer_of_few_vehicles_is_a_direction(posts_only) -> None:
    assert caveat(Question(seeds=range(5)), 14) == (
        "A direction only: 5 seeds of 600 s, 14 vehicles in a run."
    )


def test_what_cavs_would_do_is_not_told_where_none_drove(net, tmp_path) -> None:
    question = Question(net=net, demand_vph=300.0, seeds=(1,))
    both = prepare(question, tmp_path, "mine", resolve)
    alone = variant("predictive", "CAVs", 21.0)
    alone.rows[0]["uplink_mbps"] = 0.0
    text = answer(both, [*VARIANTS, alone])
    assert "Predictive with 5 % CAVs (vehicles with LiDAR and radio): 21.0 s and no CAV" in text


def test_the_page_shows_peak_and_link_and_axes_with_their_quantity(posts_only) -> None:
    page = compare_page(posts_only, VARIANTS, "cpnet compare", {})
    facts = {one.name: (one.value, one.note) for one in page.facts}
    assert facts["sent on average"] == ("0.3 Mbit/s", "all LiDARs together; peak 0.4 Mbit/s")
    assert facts["link of a LiDAR"][0] == "3.4 Mbit/s"
    charts = page.figures()
    assert all(chart.from_zero for chart in charts)
    assert [chart.y_label for chart in charts] == [
        *("delay of a vehicle, s", "time lost by a vehicle, s", "vehicles that stand"),
    ]


def test_a_net_without_demand_is_refused_with_what_to_give(net) -> None:
    with pytest.raises(ConfigError, match="no demand. Give --sumocfg FILE, --routes FILE"):
        Question(net=net).check()


def test_a_sumocfg_beside_the_net_is_named(tmp_path) -> None:
    (tmp_path / "x.sumocfg").write_text("<configuration/>")
    with pytest.raises(ConfigError, match=r"beside the net lies .*x\.sumocfg"):
        Question(net=tmp_path / "x.net.xml").check()


@pytest.mark.parametrize("tuning", TUNINGS["max_pressure"], ids=lambda one: one.text)
def test_any_fence_that_tuning_may_choose_can_be_perceived(net, tmp_path, tuning) -> None:
    comparison = prepare(Question(net=net, demand_vph=300.0), tmp_path, "mine", resolve)
    (case, *_) = perceived_cases(comparison, "max_pressure", "posts", tuning, resolve)
    assert case.scenario["edge"]["downstream_m"] == tuning.downstream_m
    assert case.scenario["signal"]["hold_s"] == tuning.own["hold_s"]
    assert case.scenario["signal"]["phases"] == tuning.settings.get("phases", "plan")


@pytest.mark.parametrize("realism", ["clear", "hard"])
def test_nobody_stops_vehicles_in_the_runs_with_perception_alone(net, tmp_path, realism) -> None:
    question = Question(net=net, demand_vph=300.0, settings={"realism": realism})
    comparison = prepare(question, tmp_path, "mine", resolve)
    (case, *_) = perceived_cases(comparison, "predictive", "posts", None, resolve)
    assert case.scenario["traffic"]["pedestrians_per_hour"] == 0
    assert case.scenario["traffic"]["lateral"]["lane_change_s"] == 0


def test_the_cabinets_times_are_the_same_with_and_without_perception(net, tmp_path) -> None:
    own = {"cabinet.yellow_s": 3, "cabinet.all_red_s": 2}
    question = Question(net=net, demand_vph=300.0, settings=own)
    comparison = prepare(question, tmp_path, "mine", resolve)
    (case, *_) = perceived_cases(comparison, "predictive", "posts", None, resolve)
    found = case.scenario["cabinet"]
    assert (found["yellow_s"], found["all_red_s"]) == (3, 2)
    assert _baselines(comparison).cabinet == {"yellow_s": 3, "all_red_s": 2}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demand_vph": 300.0, "routes": Path("r.rou.xml")}, "--routes and --demand: give one"),
        ({"demand_vph": 300.0, "seeds": (1, 101)}, "101 is a seed that baselines are tuned with"),
        ({"tls": ["A", "B"]}, r"or --routes FILE\.rou\.xml$"),
        ({"tls": "all"}, "or with one signal --demand N"),
        ({"demand_vph": 0.0}, "--demand 0: must be from 1 to 3600 vehicles per hour"),
        ({"demand_vph": -5.0}, "--demand -5: must be from 1"),
        ({"demand_vph": 3.0, "frame_period_s": 0.0}, "--frame-period 0: must be more than 0"),
        ({"demand_vph": 3.0, "posts": ["all", "centre"]}, "--posts all,centre: all stands alone"),
        ({"net": Path()}, r"--net \.: is a folder"),
        ({"demand_vph": 300.0, "settings": {"seed": 3}}, "--set seed: give --seeds instead"),
        ({"demand_vph": 3.0, "settings": {"cabinet.max_gap_s": 3}}, "is the same for all"),
        ({"demand_vph": 3.0, "settings": {"traffic.pedestrians_per_hour": 9}}, "the same for all"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options, message) -> None:
    with pytest.raises(ConfigError, match=message):
        Question(**{"net": Path("x.net.xml"), **options}).check()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tls": ["nowhere"]}, "nowhere"),
        ({"posts": ["nowhere"]}, "--posts nowhere: is none of the controlled signals: centre"),
        ({"posts": "none", "cav_rate": 0.0}, "nobody sees anything"),
    ],
)
def test_unknown_signals_and_blind_comparisons_are_refused(net, tmp_path, options, message) -> None:
    with pytest.raises(ConfigError, match=message):
        prepare(Question(net=net, demand_vph=300, **options), tmp_path, "mine", resolve)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<routes><vType id='a'/></routes>", "--routes .*: holds no vehicle, trip or flow"),
        ("<routes><route", "--routes .*: cannot be read as XML"),
        ("<net/>", "--routes .*: is a net; use --net"),
        ("<routes><flow id='NS' period='exp(420)'/></routes>", r"420 an hour are exp\(0\.1167\)"),
        ("<routes><flow id='a' end='60'/></routes>", "ends at 60 s, before warm-up and run do"),
    ],
)
def test_routes_that_cannot_be_meant_are_refused_at_once(net, tmp_path, text, message) -> None:
    (tmp_path / "r.rou.xml").write_text(text)
    question = Question(net=net, routes=tmp_path / "r.rou.xml")
    with pytest.raises(ConfigError, match=message):
        prepare(question, tmp_path, "mine", resolve)


def test_a_vehicle_that_cannot_reach_its_end_is_named(net, tmp_path) -> None:
    (tmp_path / "r.rou.xml").write_text(
        '<routes><trip id="lost" from="north_out" to="south_out" depart="2"/></routes>'
    )
    comparison = prepare(
        Question(net=net, routes=tmp_path / "r.rou.xml"), tmp_path, "mine", resolve
    )
    case = ControlCase(str(comparison.config), "plan", duration_s=10)
    with pytest.raises(ConfigError, match="SUMO gave up at .* on .*: Vehicle 'lost' has no valid"):
        CaseStore(tmp_path).run(run_flows, [BenchCase(case)], 1, lambda *_: None)


def test_a_net_that_is_given_as_a_sumocfg_is_told_apart(net, tmp_path) -> None:
    with pytest.raises(ConfigError, match="is a net; use --net"):
        prepare(Question(sumocfg=net), tmp_path, "mine", resolve)
    with pytest.raises(ConfigError, match="--routes .*: there is no such file"):
        prepare(Question(net=net, routes=tmp_path / "none"), tmp_path, "mine", resolve)


def test_a_sumocfg_is_written_anew_with_absolute_files_and_without_teleporting(tmp_path) -> None:
    (tmp_path / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><r v="a.xml, b.xml"/></input>'
        '<output><summary-output value="s.xml"/></output>'
        '<processing><time-to-teleport value="60"/></processing></configuration>'
    )
    write_config(tmp_path / "a.sumocfg", tmp_path / "b.sumocfg")
    root = ElementTree.parse(tmp_path / "b.sumocfg").getroot()
    assert {one.tag: one.get("value") for one in root} == {
        "net-file": str(tmp_path / "a.net.xml"),
        "route-files": f"{tmp_path / 'a.xml'},{tmp_path / 'b.xml'}",
        "time-to-teleport": "-1",
    }
