"""A finished cell is a whole file or none."""

from __future__ import annotations

import json

import pytest

from protocol.errors import ConfigError
from studies.sweep.cells import ResultStore
from tests.studies.sweep.made_cells import cell

pytest.importorskip("distributed", reason="needs the extra `study`")

from studies.sweep.engine import missing
from studies.sweep.worker import Outcome

ROW = {"frames": 3, "delay_s": 0.1 + 0.2, "e_cvpr": None, "e_cvpr_hist": [1, 2]}


def test_a_row_comes_back_as_it_was(store):
    store.save(cell(1), Outcome(ROW, 1.5))
    assert store.row(cell(1).id) == ROW
    assert store.row(cell(2).id) is None
    kept = json.loads((store.folder / "cells" / f"{cell(1).id}.json").read_text())
    assert kept["took_s"] == 1.5
    assert kept["scenario"] == cell(1).scenario


def test_figures_by_junction_and_region_come_back_as_they_were(store):
    junctions, regions = {"J": {"region": "r0", "delay_s": 1.5}}, {"r0": {"agents": 2.0}}
    store.save(cell(1), Outcome(ROW, 1.5, junctions, regions))
    assert store.parts(cell(1).id, "junctions") == junctions
    assert store.parts(cell(1).id, "regions") == regions
    assert store.parts(cell(2).id, "regions") is None


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"id": "another", "row": {}}'])
def test_what_is_no_whole_file_is_run_again(store, text):
    (store.folder / "cells" / f"{cell(1).id}.json").write_text(text)
    assert missing([cell(1)], store) == [cell(1)]


def test_writing_that_was_cut_off_leaves_nothing_that_counts(store, monkeypatch):
    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr("studies.sweep.cells.os.fsync", fail)
    with pytest.raises(ConfigError, match="no space left"):
        store.save(cell(1), Outcome(ROW, 1.5))
    assert store.row(cell(1).id) is None


def test_equal_cells_of_two_grids_are_run_once_in_the_order_of_the_file(store):
    cells = [cell(3, "a"), cell(1, "a"), cell(2, "a"), cell(1, "b")]
    store.save(cell(2), Outcome(ROW, 1.5))
    assert missing(cells, store) == cells[:2]


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out"):
        ResultStore.at(tmp_path / "file" / "out")


@pytest.mark.parametrize(
    "row", ["x", 5, [], {}, {"delay_s": "abc"}, {"delay_s": [1]}, {"e_cvpr_hist": ["x"]}]
)
def test_figures_that_cannot_be_are_measured_anew(store, row):
    store.save(cell(1), Outcome({"delay_s": 1.0}, 1.0))
    path = store.folder / "cells" / f"{cell(1).id}.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"row": row}))
    assert store.row(cell(1).id) is None


@pytest.mark.parametrize("parts", [None, [], {"J": None}, {"J": {"delay_s": "abc"}}])
def test_junctions_that_cannot_be_are_measured_anew(store, parts):
    store.save(cell(1), Outcome({"delay_s": 1.0}, 1.0))
    path = store.folder / "cells" / f"{cell(1).id}.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"junctions": parts}))
    assert missing([cell(1)], store) == [cell(1)]
