"""Figures of accuracy in a study's folder: what is there is not measured again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from perception.config import DetectorName
from studies.accuracy.measure import Scenario, measure_accuracy
from studies.evaluate import EvalRow
from studies.sweep.cells import ResultStore, identify, write_atomically

SCHEMA = 1
"""To be raised when the same samples would give other rows: all is measured anew."""

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
    """Returns an id of all that decides the rows: keys, files, this version."""
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
