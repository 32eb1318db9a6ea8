"""The table has the file's order and columns; figures over seeds are those of a textbook."""

from __future__ import annotations

import math

import pytest

from protocol.errors import ConfigError
from tests.studies.sweep.made_cells import cell

pl = pytest.importorskip("polars", reason="needs the extra `study`")
pytest.importorskip("scipy", reason="needs the extra `study`")

from studies.sweep.results import over_seeds, parts_table, table, write_table  # noqa: E402
from studies.sweep.worker import Outcome  # noqa: E402


def filled(store, cells, row=lambda c: {"frames": c.seed, "delay_s": c.seed / 2}):
    for one in reversed(cells):
        store.save(one, Outcome(row(one), 1.0))
    return table(cells, store)


def test_rows_stand_in_the_order_of_the_file_whatever_was_done_first(store):
    cells = [cell(seed, rate=rate) for rate in (0.5, 0) for seed in (2, 1)]
    frame = filled(store, cells)
    assert frame.columns == ["grid", "rate", "seed", "frames", "delay_s"]
    assert frame.select("rate", "seed").rows() == [(0.5, 2), (0.5, 1), (0.0, 2), (0.0, 1)]


def test_a_cell_that_is_not_done_has_no_row_and_leaves_types_as_they_are(store):
    cells = [cell(1, policy="a"), cell(1, policy=3), cell(1, "b", rate=0.5), cell(1, "b", rate=1)]
    whole = filled(store, cells)
    assert whole.schema["policy"] == pl.String
    assert whole.schema["rate"] == pl.Float64
    assert whole["policy"].to_list() == ["a", "3", None, None]
    (store.folder / "cells" / f"{cells[0].id}.json").unlink()
    part = table(cells, store)
    assert part.schema == whole.schema
    assert part.equals(whole[1:])


def test_equal_cells_have_a_row_in_each_grid(store):
    frame = filled(store, [cell(1, "a"), cell(1, "b")])
    assert frame["grid"].to_list() == ["a", "b"]


def test_each_junction_of_each_cell_has_a_row(store):
    cells = [cell(seed, rate=0.5) for seed in (1, 2)]
    for one in cells:
        rows = {tls: {"region": "r0", "delay_s": one.seed * 1.5} for tls in "JK"}
        store.save(one, Outcome({"frames": 1}, 1.0, rows))
    frame = parts_table([*cells, cell(3, rate=0.5)], store, "junctions")
    assert frame.columns == ["grid", "rate", "seed", "tls", "region", "delay_s"]
    assert frame.select("seed", "tls", "delay_s").rows() == [
        (1, "J", 1.5), (1, "K", 1.5), (2, "J", 3.0), (2, "K", 3.0),
    ]  # fmt: skip
    assert len(parts_table(cells, store, "regions")) == 0


def test_measures_keep_their_kinds(store):
    rows = {1: {"n": 1, "x": None, "h": [1, 2], "t": "a"}, 2: {"n": 2, "x": 1, "h": [], "t": None}}
    frame = filled(store, [cell(1), cell(2)], lambda c: rows[c.seed])
    kinds = [pl.Int64, pl.Float64, pl.List(pl.Int64), pl.String]
    assert [frame.schema[name] for name in "nxht"] == kinds
    assert frame.select(*"nxht").rows() == [(1, None, [1, 2], "a"), (2, 1.0, [], None)]


def test_the_file_is_the_same_bytes_for_the_same_cells(store):
    path = write_table(filled(store, [cell(1), cell(2)]), store)
    first = path.read_bytes()
    assert write_table(table([cell(1), cell(2)], store), store).read_bytes() == first
    assert pl.read_parquet(path).equals(table([cell(1), cell(2)], store))


def test_an_axis_called_like_a_measure_is_refused(store):
    with pytest.raises(ConfigError, match="the axis frames is called like a measure"):
        filled(store, [cell(1, frames=3)])


def test_figures_over_seeds_are_those_computed_by_hand():
    frame = pl.DataFrame(
        {
            "policy": ["b", "b", "b", "a", "c", "c"],
            "x": [1.0, 2.0, 3.0, 7.0, None, 4.0],
            "y": [None, 1, 2, None, None, None],
        },
        schema={"policy": pl.String, "x": pl.Float64, "y": pl.Float64},
    )
    found = over_seeds(frame, ["policy"], ["x", "y"])
    assert found.columns == [
        "policy", "n", "x_mean", "x_sd", "x_ci95", "x_values", "y_mean", "y_sd", "y_ci95",
        "y_values",
    ]  # fmt: skip
    b, a, c = found.rows(named=True)
    assert (b["policy"], b["n"], b["x_mean"], b["x_sd"]) == ("b", 3, 2.0, 1.0)
    assert b["x_ci95"] == pytest.approx(4.30265 / math.sqrt(3), rel=1e-5)  # t of 2, 97.5 %
    assert b["y_ci95"] == pytest.approx(12.7062 * math.sqrt(0.5) / math.sqrt(2), rel=1e-5)
    assert (a["n"], a["x_mean"], a["x_sd"], a["x_ci95"], a["y_mean"]) == (1, 7.0, None, None, None)
    assert (c["n"], c["x_mean"], c["x_ci95"]) == (2, 4.0, None)
