"""Figures in README and docs are those of docs/figures/*.json, with their age."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from signal_controller.observation import CabinetTimes
from sim_host.junctions import DEMAND_VPH_PER_LANE
from sim_host.setup import build_setup
from studies.control_baselines import SATURATION_VPH, webster_signal

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
ADVICE = "run `scripts/figures --write`"


@pytest.fixture
def make(monkeypatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "figures"))
    return importlib.import_module("make")


@pytest.fixture
def fresh(make, monkeypatch) -> dict:
    """The record of `rate`, as if it had been measured on the code as it is."""
    figure = make.FIGURES["rate"]
    record = make.load(figure) | {
        "commit": "0123456789abcdef", "date": "2026-11-23",
        "machine": {"cpu": "Xeon", "cores": 2}, "sources": make.digest(figure),
    }  # fmt: skip
    monkeypatch.setattr(make, "load", lambda figure: record)
    return record


@pytest.mark.parametrize("page", PAGES)
def test_pages_show_what_the_files_hold_and_its_age(make, page) -> None:
    assert make.written(page) == (ROOT / page).read_text("utf-8"), ADVICE


def test_each_figure_has_a_file_and_each_file_a_figure(make) -> None:
    stored = {path.stem for path in (ROOT / "docs" / "figures").glob("*.json")}
    assert stored == set(make.FIGURES)


def test_each_part_stands_on_its_page_once(make) -> None:
    for figure in make.FIGURES.values():
        for part in figure.parts:
            text = (ROOT / part.page).read_text("utf-8")
            assert text.count(f"<!-- figure: {figure.name}.{part.name} -->") == 1


def test_parts_are_those_that_the_measured_data_give(make) -> None:
    for figure in make.FIGURES.values():
        record = make.load(figure)
        assert make.refresh(figure, record) == record, ADVICE


def test_generated_pages_and_pictures_are_as_their_commands_left_them(make) -> None:
    for figure in make.FIGURES.values():
        if figure.files:
            assert figure.digests(ROOT) == make.load(figure)["data"]["files"], figure.name


def test_every_measured_source_exists(make) -> None:
    for figure in make.FIGURES.values():
        assert re.fullmatch(r"[0-9a-f]{16}", make.digest(figure))


def test_a_figure_of_the_code_as_it_is_names_commit_and_machine(make, fresh) -> None:
    figure = make.FIGURES["rate"]
    assert make.age(figure, fresh) == "measured at commit 0123456, 2026-11-23, 2 cores, Xeon"
    assert make.is_fresh(figure)


def test_a_figure_older_than_its_code_says_so(make, fresh, monkeypatch) -> None:
    figure = make.FIGURES["rate"]
    monkeypatch.setattr(make, "digest", lambda figure: "another")
    assert make.age(figure, fresh).endswith("Xeon; the code has changed since")
    assert not make.is_fresh(figure)


def test_a_figure_of_rows_stays_fresh_where_the_code_gives_the_same_rows(
    make, monkeypatch, tmp_path
) -> None:
    before = {"sources": "before", "commit": "0123456789", "same": {}}  # never compared
    record = make.load(make.FIGURES["delay"]) | before
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    monkeypatch.setattr(make, "FIGURES", {"delay": make.FIGURES["delay"]})
    make.save(make.FIGURES["delay"], record)
    monkeypatch.setattr(make, "_git", lambda *_: "c0ffee0123")
    commits = []

    def compared(root: Path, work: Path, then: str, now: str) -> list[SimpleNamespace]:
        commits.append(then)
        differing = [] if len(commits) > 1 else ["other rows"]
        return [
            run_of(title, differences, detector=detector, is_tracked=True)
            for title, detector, differences in (
                ("a", "fast", differing),
                ("b", "pointpillars", ["other rows"]),
            )
        ]

    monkeypatch.setattr(make, "compared", compared)
    make.compare_rows([])
    assert not make.is_fresh(make.FIGURES["delay"])
    make.compare_rows(["delay"])
    age = make.age(make.FIGURES["delay"], make.load(make.FIGURES["delay"]))
    assert age.endswith("; in 1 runs commit c0ffee0 gives the same rows")
    make.compare_rows([])  # it is fresh, and not compared again
    assert commits == ["0123456789"] * 2


@pytest.fixture
def uplink(make, monkeypatch, tmp_path) -> SimpleNamespace:
    """Returns a figure of speed, which no rows tell whether it is fresh, in a folder of its own.

    `trees` says what digest the code of each commit has, `now` which the code has today.
    """
    figure = make.FIGURES["uplink"]
    record, trees = make.load(figure), {make.ROOT: "now"}
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    monkeypatch.setattr(make, "FIGURES", {"uplink": figure})
    monkeypatch.setattr(make, "tree_of", lambda root, work, commit: nullcontext(commit))

    def digest(_, root=make.ROOT) -> str:
        if root not in trees:
            raise FileNotFoundError(root)
        return trees[root]

    monkeypatch.setattr(make, "digest", digest)
    stored = {"sources": "before", "commit": "0123456", "command": figure.command}

    def store(**changes: object) -> None:
        make.save(figure, record | stored | {"same": {}} | changes)

    return SimpleNamespace(figure=figure, trees=trees, store=store)


@pytest.mark.parametrize(
    ("same", "compared", "says"),
    [
        ({}, "0123456", "; what it measures has not changed since"),
        ({"commit": "c0ffee0", "runs": 13, "sources": "old"}, "c0ffee0", "13 runs commit c0ffee0"),
    ],
)
def test_a_figure_stays_fresh_where_the_code_is_that_of_its_commit(
    make, uplink, same, compared, says
) -> None:
    uplink.store(same=same)
    uplink.trees[compared] = "now"
    make.compare_code(["uplink"])
    assert make.is_fresh(uplink.figure)
    assert says in make.age(uplink.figure, make.load(uplink.figure))


@pytest.mark.parametrize(
    ("tree", "changes"),
    [
        ("another", {}),  # code
        (None, {}),  # a file that it measures was not there
        ("now", {"command": "cpnet bench uplink --seed 2"}),
        ("now", {"is_committed": False}),  # measured with changes that no commit has
    ],
)
def test_a_figure_of_other_code_stays_older(make, uplink, capsys, tree, changes) -> None:
    uplink.store(**changes)
    if tree is not None:
        uplink.trees["0123456"] = tree
    make.compare_code([])
    assert not make.is_fresh(uplink.figure)
    assert "uplink: not the code at 0123456" in capsys.readouterr().err


def run_of(
    title: str,
    differences: list[str],
    *,
    detector: str = "fast",
    is_tracked: bool = False,
    is_predictive: bool = False,
) -> SimpleNamespace:
    return SimpleNamespace(
        title=title,
        detector=detector,
        is_tracked=is_tracked,
        is_predictive=is_predictive,
        differences=differences,
    )


@pytest.mark.parametrize("differing", [{"is_tracked": True}, {"is_predictive": True}], ids=str)
def test_what_a_figure_does_not_show_does_not_age_it(
    make, monkeypatch, tmp_path, differing
) -> None:
    figures = {name: make.FIGURES[name] for name in ("ecvpr", "delay")}
    before = {"sources": "before", "commit": "0123456789", "same": {}}
    records = {name: make.load(figure) | before for name, figure in figures.items()}
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    monkeypatch.setattr(make, "FIGURES", figures)
    for name, record in records.items():
        make.save(figures[name], record)
    monkeypatch.setattr(make, "_git", lambda *_: "c0ffee0123")
    runs = [run_of("a", ["other rows"], **differing), run_of("b", [])]
    monkeypatch.setattr(make, "compared", lambda *_: runs)
    make.compare_rows([])
    assert {name: make.is_fresh(one) for name, one in figures.items()} == {
        "ecvpr": True,
        "delay": False,
    }


def test_a_figure_of_policies_stays_fresh_where_these_give_the_same_rows(
    make, monkeypatch, tmp_path
) -> None:
    figure = make.FIGURES["grid"]
    record = make.load(figure) | {"sources": "before", "commit": "0123456789", "same": {}}
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    monkeypatch.setattr(make, "WORK", tmp_path / "work")
    monkeypatch.setattr(make, "FIGURES", {"grid": figure})
    make.save(figure, record)
    monkeypatch.setattr(make, "_git", lambda *_: "c0ffee0123")
    same_rows = sys.modules["same_rows"]
    monkeypatch.setattr(same_rows, "tree_of", lambda *_: nullcontext(tmp_path))
    rows = {
        commit: [
            {"net": "grid", "policy": "webster", "seed": 1, "delay_s": 7.0, "decide_p50_ms": ms}
        ]
        for ms, commit in enumerate(("0123456789", "c0ffee0123"))
    }

    def bench(command, *, cwd, env, stdout, check) -> SimpleNamespace:
        commit = "c0ffee0123" if env["PYTHONPATH"] == str(make.ROOT) else "0123456789"
        return SimpleNamespace(stdout=json.dumps(rows[commit]).encode())

    monkeypatch.setattr(same_rows.subprocess, "run", bench)
    rows["c0ffee0123"].append(rows["c0ffee0123"][0] | {"policy": "predictive"})
    make.compare_rows([])
    assert not make.is_fresh(figure), "a row more"
    rows["c0ffee0123"].pop()
    shutil.rmtree(make.WORK)
    make.compare_rows([])
    assert make.is_fresh(figure), "the same rows, whatever the times"


def test_a_figure_that_shows_a_learned_detector_is_older_than_its_weights(make) -> None:
    for figure in make.FIGURES.values():
        studied = [Path(one) for one in re.findall(r"\$ROOT/(\S+\.yaml)", figure.command)]
        studied += [
            Path(f"studies/builtin/{one}.yaml")
            for one in re.findall(r"study (\w+)", figure.command)
        ]
        text = figure.command + "".join((ROOT / one).read_text() for one in studied)
        assert figure.learned == (
            figure.of_rows and bool(re.search(r"pointpillars(?!-full)", text))
        )


def test_a_changed_source_changes_the_digest(make, monkeypatch, tmp_path) -> None:
    figure = make.FIGURES["codec"]
    monkeypatch.setattr(make, "ROOT", tmp_path)
    for name in figure.sources:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1\n")
    before = make.digest(figure)
    (tmp_path / figure.sources[0]).write_text("2\n")
    assert make.digest(figure) != before


def test_a_marker_of_no_figure_is_an_error(make, monkeypatch, tmp_path) -> None:
    (tmp_path / "page.md").write_text("# Page\n<!-- figure: nothing.here -->\n<!-- /figure -->\n")
    monkeypatch.setattr(make, "ROOT", tmp_path)
    with pytest.raises(KeyError, match="nothing.here"):
        make.written("page.md")


def test_a_measurement_keeps_commit_machine_command_and_data(make, monkeypatch, tmp_path) -> None:
    figure = make.Figure(
        "tiny", "echo '[1, 2]'", ("docs/figures/make.py",), 0,
        (make.Part("all", "docs/uplink.md", lambda data: [["n"], *([str(n)] for n in data)]),),
    )  # fmt: skip
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    monkeypatch.setattr(make, "WORK", tmp_path / "work")
    monkeypatch.setattr(make, "_git", lambda *_: "c0ffee")
    make.measure(figure)
    record = make.load(figure)
    assert record["data"] == [1, 2]
    assert record["parts"] == {"all": [["n"], ["1"], ["2"]]}
    assert (record["commit"], record["command"]) == ("c0ffee", "echo '[1, 2]'")
    assert record["machine"]["cores"] >= 1
    assert make.is_fresh(figure)


def test_a_figure_does_not_age_by_comments_and_docstrings(make) -> None:
    code = b'def speed(way_m):\n    label = "# no comment"\n    return way_m, label'
    documented = '''"""A module."""

def speed(way_m):  # a function
    """Returns a speed.

    In metres a second.
    """

    label = "# no comment"
    return way_m, label
'''
    assert make.executed(documented) == make.executed(code.decode()) == code
    assert make.executed(documented.replace("way_m, label", "way_m")) != code


def test_delays_are_paired_by_seed_and_of_few_seeds_each_is_shown(make) -> None:
    comparison = importlib.import_module("layouts.comparison")
    rows = [
        {"control": name, "seed": seed, "frames": 300, "delay_s": seed + more}
        for more, name in enumerate(comparison._CONTROLS)
        for seed in range(1, 4)
    ]
    head, first, second, *_ = comparison.delay(rows)
    assert head[1] == "delay, s; 3 seeds of 300 s"
    assert first[1:3] == ["1.0, 2.0, 3.0", ""]
    assert second[2] == "1.0, 1.0, 1.0"


def test_each_step_of_e_cvpr_is_paired_with_the_one_before_and_names_its_lidar(make) -> None:
    comparison = importlib.import_module("layouts.comparison")
    lidar = {"channels": 64, "points_per_second": 56000, "range": 80.0}
    rows = [
        {"grid": "steps", "step": step, "seed": seed, "lidar": lidar, "visible_share": 0.5,
         "e_cvpr": seed / 10 - less}
        for step, less in (("ours", 0.0), ("theirs", 0.05))
        for seed in range(1, 6)
    ]  # fmt: skip
    _, ours, theirs = comparison.ecvpr_steps(rows)
    assert ours[1:4] == ["64", "56,000", "80"]
    assert (ours[5], theirs[5]) == ("", "-5.0 ± 0.0")


@pytest.mark.parametrize(("control", "cycle_factor"), [("webster", 1), ("webster, tuned", 0.85)])
def test_fixed_plans_of_the_figure_delay_are_websters_for_the_demand(
    make, tmp_path, control, cycle_factor
) -> None:
    study = yaml.safe_load((ROOT / "docs/figures/delay.yaml").read_text("utf-8"))
    given = study["axes"]["control"][control]["cabinet.plan_greens_s"]
    signal = build_setup({}, tmp_path).road_map.intersections[0].signal
    lanes = {link.from_lane for link in signal.links}
    flows = {lane: DEMAND_VPH_PER_LANE.get(lane.rpartition("_")[0], 500.0) for lane in lanes}
    times = CabinetTimes(5, 4, 1)
    found = webster_signal(signal, flows, SATURATION_VPH, times, cycle_factor).plan
    assert given == [phase.duration_s for phase in found if phase.is_green]


def test_tunings_of_the_figure_delay_are_those_found_on_other_seeds(make) -> None:
    study = yaml.safe_load((ROOT / "docs/figures/delay.yaml").read_text("utf-8"))
    controls = study["axes"]["control"]
    found = {row["policy"]: row["setting"] for row in make.load(make.FIGURES["tuned"])["data"]}
    loops = controls["actuated, tuned"]
    assert found["actuated"] == (
        f"gap {loops['cabinet.max_gap_s']:g} s, loops {loops['cabinet.detector_gap_s']:g} s "
        f"before, at most {loops['cabinet.max_green_s']:g} s"
    )
    held = controls["perfect counts, held"]
    assert found["max_pressure"] == (
        f"{held['edge.upstream_m']:g} m before, {held['edge.downstream_m']:g} m behind, "
        f"greens of {held['signal.hold_s']:g} s"
    )
    assert found["webster"] == "cycle x 0.85"
