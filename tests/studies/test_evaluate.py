"""What is counted in an evaluation, on made-up samples and with a made-up detector."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from cpnet.evaluation import Source, detectors_of
from edge_server.config import EdgeConfig
from learning.dataset import SceneSample
from protocol.errors import ConfigError
from studies import evaluate as study
from studies.evaluate import Site, evaluate
from studies.evaluation_tables import print_evaluation
from tests.roads import junction_road
from tests.studies.made_samples import ScriptedDetector, car, scene_sample


def rows_with(
    monkeypatch: pytest.MonkeyPatch, sample: SceneSample, boxes: list[list[float]]
) -> Any:
    monkeypatch.setattr(study, "detector_of", lambda *_: ScriptedDetector(boxes))
    rows = evaluate([(Site(junction_road(), EdgeConfig()), sample)], ["fast"])

    def of(**wanted: Any) -> Any:
        plain = {"part": "all", "view": "bev", "iou": 0.5, "geofence": False, "objects": "vehicle"}
        wanted = plain | wanted
        (row,) = [r for r in rows if all(getattr(r, k) == v for k, v in wanted.items())]
        return row

    return of


def test_vehicles_with_few_points_are_counted_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [car(-30, 1.75), car(20, -1.75)]
    of = rows_with(monkeypatch, scene_sample(boxes, [[50, 2], [0, 2]], None), boxes[:1])
    assert of(fusion="early", truth="all").recall == 0.5
    assert of(fusion="early", truth="visible").recall == 1.0
    assert of(fusion="early", truth="all", part="1-4 points").vehicles == 1
    assert of(fusion="early", truth="all", part="1-4 points").recall == 0.0
    assert of(fusion="early", truth="visible", part="30-50 m").ap40 == 1.0


def test_the_geofence_drops_detections_beside_the_road(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [car(-30, 1.75)]
    sample = scene_sample(boxes, [[50], [50]], None)
    of = rows_with(monkeypatch, sample, [*boxes, car(-30, 20)])
    assert of(fusion="early", truth="all", geofence=False).precision == 0.5
    assert of(fusion="early", truth="all", geofence=True).precision == 1.0


def test_nobody_misses_the_vehicle_it_stands_on(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [car(-30, 1.75), car(40, 1.75)]
    of = rows_with(monkeypatch, scene_sample(boxes, [[50, 50], [50, 0]], 1), [])
    assert of(cloud="single", truth="all").vehicles == 3
    assert of(fusion="early", truth="all").vehicles == 2


def test_what_is_out_of_range_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [car(-30, 1.75), car(-100, 1.75)]
    sample = scene_sample(boxes, [[50, 50], [50, 50]], None)
    of = rows_with(monkeypatch, sample, [car(-30, 1.75), car(-90, 1.75)])
    row = of(fusion="early", truth="all")
    assert (row.vehicles, row.recall, row.precision) == (1, 1.0, 1.0)


def test_late_fusion_makes_one_of_what_two_sensors_found(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [car(-30, 1.75)]
    of = rows_with(monkeypatch, scene_sample(boxes, [[50], [50]], None), boxes)
    assert of(fusion="late", truth="all").precision == 1.0


def test_the_fast_detector_finds_cars_with_and_without_geofence() -> None:
    boxes = [car(-30, 1.75), car(20, -1.75), car(-50, -1.75)]
    sample = scene_sample(boxes, [[300] * 3, [300] * 3], None)
    rows = evaluate([(Site(junction_road(), EdgeConfig()), sample)], ["fast"])
    for row in rows:
        if row.part == "all" and row.iou <= 0.3 and row.objects in ("vehicle", "car"):
            assert row.recall == 1.0
    out = io.StringIO()
    print_evaluation(rows, Console(file=out, width=80))
    assert "…" not in out.getvalue()
    assert "Chen DBSCAN" in out.getvalue()


def test_mistakes_of_an_evaluation_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must be one of fast, reference"):
        detectors_of("fast,slow")
    with pytest.raises(ConfigError, match="not both"):
        Source(tmp_path, tmp_path, None, "test", 1).open(EdgeConfig())
    with pytest.raises(ConfigError, match="cpnet dataset"):
        Source(None, None, None, "test", 1).open(EdgeConfig())
    with pytest.raises(ConfigError, match="no such file"):
        Source(None, tmp_path / "none.net.xml", None, "test", 1).open(EdgeConfig())
