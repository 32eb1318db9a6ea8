"""Figures 3, 5 and 7."""

from pathlib import Path

import pytest

from edge_server.config import EdgeConfig
from studies import accuracy_pictures, evaluate
from studies.accuracy_pictures import (
    SHOWN_POINTS,
    best_of,
    cloud_maps,
    fusion_maps,
    scenes_section,
    shown_sample,
    truth_map,
)
from studies.evaluate import Site
from studies.page.model import MapChart, Page, Section, flattened
from studies.page.write import to_markdown
from tests.roads import junction_road
from tests.studies.accuracy.small import small
from tests.studies.made_samples import ScriptedDetector, car, scene_sample

SEEN, MISSED, HIDDEN, AWAY = car(-30, 1.75), car(20, -1.75), car(30, 1.75), car(-80, 1.75)


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch):
    """Two scans in which one car is found twice and one never; a third has no points."""
    monkeypatch.setattr(evaluate, "detector_of", lambda *_: ScriptedDetector([SEEN, car(0, 1.75)]))
    points_on = [[50, 9, 1, 50], [50, 0, 0, 50]]
    sample = scene_sample([SEEN, MISSED, HIDDEN, AWAY], points_on, None)
    return shown_sample(Site(junction_road(), EdgeConfig()), sample, "fast")


def rings(chart: MapChart) -> dict[str, int]:
    return {one.name: len(one.rings) for one in chart.outlines}


def marks(chart: MapChart) -> dict[str, int]:
    return {one.name: len(one.x_m) for one in chart.points}


def test_detections_are_doubled_before_fusion_and_single_after(view) -> None:
    before, after = fusion_maps(view)
    assert rings(before) == {"rsu-0": 2, "cav": 2}
    assert "4 detections of 2 scans" in before.notes
    assert rings(after) == {"detected": 2}


def test_vehicles_are_told_apart_by_how_they_were_seen(view) -> None:
    chart = truth_map(view)
    assert rings(chart) == {
        "vehicle with too few points": 1,
        "vehicle, found": 1,
        "vehicle, visible but missed": 1,
        "detected": 2,
    }
    assert marks(chart) == {"missed": 1, "false detection": 1}
    assert "found: 1 of 2; vehicles in all: 3" in chart.notes


def test_clouds_have_an_agents_colour_and_few_points(view) -> None:
    single, merged = cloud_maps(view)
    colours = {one.name: one.colour for one in merged.points}
    assert list(colours) == ["rsu-0", "cav"]
    assert len(set(colours.values())) == 2
    assert {one.name: one.colour for one in single.points} == {"rsu-0": colours["rsu-0"]}
    for chart in (single, merged):
        assert 0 < sum(marks(chart).values()) <= SHOWN_POINTS + 2


def test_the_sample_with_the_most_scans_is_shown() -> None:
    few, more = (scene_sample([SEEN], [[n], [n]], None) for n in (2, 9))
    assert best_of([few, more, more]) is more
    assert best_of([]) is None


@pytest.fixture(scope="module")
def section() -> Section:
    return scenes_section(small(), "fast", 2)


def test_the_same_scenario_gives_the_same_pictures(section: Section) -> None:
    assert scenes_section(small(), "fast", 2) == section
    charts = [block for block in flattened(section.blocks) if isinstance(block, MapChart)]
    assert len(charts) == 5
    for chart in charts:
        assert chart.window == charts[0].window
        assert chart.surfaces
    left, low, right, high = charts[0].window or (0.0, 0.0, 0.0, 0.0)
    assert right - left == 100
    assert 20 < high - low < 60


def test_the_pictures_can_be_drawn(section: Section, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="extra plot")
    to_markdown(Page("Accuracy", "", (section,)), tmp_path, "p")
    assert len(list(tmp_path.glob("*.png"))) == 5


def test_where_nobody_scans_there_is_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy_pictures, "junction_of", lambda *_: (None, []))
    assert len(scenes_section({}, "fast").blocks) == 1
