"""Rows in a study's folder."""

from pathlib import Path
from typing import Any

import pytest

from studies import accuracy
from studies.accuracy import accuracy_of
from studies.evaluate import EvalRow
from tests.studies.accuracy.rows import made_up_rows
from tests.studies.accuracy.small import small


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What was asked to be measured."""
    spec: list[Any] = []

    def measure(*what: Any) -> list[EvalRow]:
        spec.append(what)
        return made_up_rows()

    monkeypatch.setattr(accuracy, "measure_accuracy", measure)
    return spec


def test_what_is_kept_is_not_measured_again(tmp_path: Path, measured: list[Any]) -> None:
    first = accuracy_of(small(), ["fast"], 2, tmp_path)
    assert accuracy_of(small(), ["fast"], 2, tmp_path) == first == made_up_rows()
    assert accuracy_of(small() | {"duration_s": 9.0}, ["fast"], 2, tmp_path) == first
    assert len(measured) == 1
    assert len(list(tmp_path.glob("accuracy-*.json"))) == 1


def test_whatever_decides_the_rows_is_measured_for_itself(
    tmp_path: Path, measured: list[Any]
) -> None:
    accuracy_of(small(), ["fast"], 2, tmp_path)
    accuracy_of(small(), ["fast"], 3, tmp_path)
    accuracy_of(small(), ["fast", "pointpillars"], 2, tmp_path)
    accuracy_of(small() | {"seed": 2}, ["fast"], 2, tmp_path)
    accuracy_of(small() | {"sensor_height_m": 3.0}, ["fast"], 2, tmp_path)
    assert len(measured) == 5


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"id": "ID"}', '{"id": "ID", "rows": [{}]}'])
def test_a_file_that_is_none_is_measured_anew(
    tmp_path: Path, measured: list[Any], text: str
) -> None:
    rows = accuracy_of(small(), ["fast"], 2, tmp_path)
    (path,) = tmp_path.glob("accuracy-*.json")
    path.write_text(text.replace("ID", path.stem.removeprefix("accuracy-")))
    assert accuracy_of(small(), ["fast"], 2, tmp_path) == rows
    assert len(measured) == 2
