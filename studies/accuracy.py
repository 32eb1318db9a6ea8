"""Table 1 of Chen et al. 2022: AP40 at a scenario's junction, kept in the study's folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from edge_server.config import EdgeConfig
from learning.dataset import SceneSample
from learning.scanner import samples_of, scanner_of
from perception.config import DetectorName
from protocol.errors import ConfigError
from studies.average_precision import View
from studies.ecvpr import VISIBLE_POINTS
from studies.evaluate import EVERYTHING, VEHICLE, VIEWS, EvalRow, Site, Truth, evaluate
from studies.evaluation_tables import PAPER
from studies.page.model import Cell, Column, Section, Table, Text
from studies.sweep.cells import ResultStore, identify, write_atomically

Scenario = dict[str, Any]
MAX_SAMPLES = 500


def measure_accuracy(
    scenario: Scenario, detectors: Sequence[DetectorName], samples: int
) -> list[EvalRow]:
    """Returns all rows of these detectors at the junction of a scenario with all its keys.

    The scenario's seed decides all but `detect_ms`.

    Raises:
        ConfigError: the junction or a detector is not available.
    """
    site, listed = junction_of(scenario, samples)
    return evaluate(((site, sample) for sample in listed), detectors)


def junction_of(scenario: Scenario, samples: int) -> tuple[Site, Iterator[SceneSample]]:
    """Returns a scenario's junction and its samples; fewer samples are the first of more.

    Raises:
        ConfigError: there are too few or too many, or the junction is not available.
    """
    if not 1 <= samples <= MAX_SAMPLES:
        raise ConfigError(f"samples {samples}: must be 1 to {MAX_SAMPLES}")
    scanner = scanner_of(scenario, samples)
    site = Site(scanner.road_map, EdgeConfig.model_validate(scenario["edge"]))
    return site, samples_of(scanner)


SCHEMA = 2
"""Version, to be raised when the same samples give other rows: all are measured again."""

_DECIDE = (
    "seed", "traffic", "lidar", "sensor_height_m", "roadside_mounts", "scene", "pose", "edge",
)  # fmt: skip


def accuracy_of(
    scenario: Scenario, detectors: Sequence[DetectorName], samples: int, store_folder: Path
) -> list[EvalRow]:
    """Returns the rows of `measure_accuracy`: from the folder, else measured and kept there.

    Raises:
        ConfigError: they cannot be measured, or the folder cannot be written.
    """
    name = identity(scenario, detectors, samples)
    path = ResultStore.at(store_folder).folder / f"accuracy-{name}.json"
    rows = _read(path, name)
    if rows is None:
        rows = measure_accuracy(scenario, detectors, samples)
        data = {"id": name, "rows": [row.as_json() for row in rows]}
        write_atomically(path, json.dumps(data, indent=1).encode())
    return rows


def identity(scenario: Scenario, detectors: Sequence[DetectorName], samples: int) -> str:
    """Returns a hash of all that decides the rows: keys, files, this version."""
    scene = identify({key: scenario[key] for key in _DECIDE})
    decides = json.dumps([scene, list(detectors), samples, SCHEMA])
    return hashlib.sha256(decides.encode()).hexdigest()[:16]


def _read(path: Path, name: str) -> list[EvalRow] | None:
    try:
        data: Any = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(data, dict) or data.get("id") != name:
        return None
    keys = {field.name for field in fields(EvalRow)}
    rows = data.get("rows")
    if not isinstance(rows, list) or any(set(row) != keys for row in rows):
        return None
    return [EvalRow(**row) for row in rows]


SHOWN_IOUS = (0.01, 0.1, 0.5)
_CLOUD_NAMES = {"none": "one scan", "early": "merged", "late": "each scan, then fused"}
_TRUTHS: dict[Truth, str] = {"visible": "visible", "all": "all"}
_VIEW_NAMES: dict[View, str] = {"bev": "BEV", "3d": "3D"}
_COLUMNS = (
    Column("detector"),
    Column("cloud"),
    Column("vehicles"),
    *(Column(f"{_VIEW_NAMES[view]} {iou:g}", ".1f") for view in VIEWS for iou in SHOWN_IOUS),
)


def accuracy_section(rows: list[EvalRow]) -> Section:
    """Returns AP40 with and without geofence, the paper's figures first."""
    title = "Table 1: average precision"
    vehicles = [row for row in rows if row.objects == VEHICLE]
    whole = [row for row in vehicles if row.part == EVERYTHING and row.iou in SHOWN_IOUS]
    if not whole:
        return Section(title, (Text("No sample had a scan, so that there is nothing to rank."),))
    tables = (
        _table(whole, geofence=False, caption="Without geofence, as in the paper: AP40, %"),
        _table(whole, geofence=True, caption="With geofence, as the edge works: AP40, %"),
    )
    return Section(title, (Text(_said(whole)), *tables))


def _table(rows: list[EvalRow], *, geofence: bool, caption: str) -> Table:
    lines: dict[tuple[str, str, str], dict[tuple[View, float], float | None]] = {}
    for row in rows:
        if row.geofence == geofence:
            key = (row.detector, _CLOUD_NAMES[row.fusion], _TRUTHS[row.truth])
            lines.setdefault(key, {})[row.view, row.iou] = row.ap40
    order = {truth: place for place, truth in enumerate(_TRUTHS.values())}
    own = sorted(lines.items(), key=lambda line: order[line[0][2]])
    ours = tuple((*key, *_figures(cells, 100.0)) for key, cells in own)
    return Table(_COLUMNS, (*_paper_rows(geofence=geofence), *ours), caption)


def _paper_rows(*, geofence: bool) -> tuple[tuple[Cell, ...], ...]:
    """Returns the paper's figures, marked as without geofence beside ours with it."""
    note = ", no geofence" if geofence else ""
    names = dict.fromkeys(name for name, _ in PAPER)
    return tuple(
        (
            f"{name}, Chen et al.{note}",
            "merged",
            "visible",
            *_figures({(v, i): a for v in VIEWS for i, a in PAPER[name, v].items()}, 1.0),
        )
        for name in names
    )


def _figures(cells: dict[tuple[View, float], float | None], factor: float) -> tuple[Cell, ...]:
    """Returns AP40 in percent in the order of the columns."""
    found = [cells.get((view, iou)) for view in VIEWS for iou in SHOWN_IOUS]
    return tuple(None if one is None else round(factor * one, 2) for one in found)


def _said(rows: list[EvalRow]) -> str:
    """Returns the caption: what the figures are of, and how the paper's differ."""
    scenes = {row.fusion: row.scenes for row in rows}
    of = {row.truth: row.vehicles for row in rows if row.fusion == "early" and not row.geofence}
    return (
        f"{scenes['early']} samples with {scenes['none']} scans, some seconds apart, each scan one "
        "revolution of a tenth of a second, as at 10 Hz: those of the posts and of up to five CAVs "
        "near the junction, drawn anew each time. Of "
        f"{of['all']} vehicles within 80 m of the junction's centre {of['visible']} are visible: "
        f"{VISIBLE_POINTS} points or more lie on them, of all scans together. A column is the IoU "
        "above which a box counts, from above (BEV) or as a volume (3D). The paper's clouds come "
        "from CARLA and were not geofenced; ours come from this LiDAR model, at this junction."
    )
