"""The database file: killed writers, foreign files, comparison of runs."""

import json
import multiprocessing
import os
import signal
import sqlite3
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from recording.database import FILE_NAME, Database
from recording.run import RESULTS, Run, differences
from recording.tables import (
    SCHEMA_VERSION,
    TABLES,
    CountRow,
    FrameRow,
    MetaRow,
    RequestRow,
    SightingRow,
    StageRow,
    TripRow,
)


def record(run_dir: Path, counts: list[CountRow], clock_ns: int = 0) -> None:
    run_dir.mkdir()
    database = Database(run_dir)
    database.add(CountRow, counts)
    database.add(StageRow, [StageRow(0, "edge", "", "merge", clock_ns, clock_ns)])
    database.close()


def _write_until_killed(run_dir: Path, ready: Connection) -> None:
    database = Database(run_dir)
    database.add(CountRow, [(0, "J", "a", "upstream", 1, 0, 0)])
    database.commit()
    database.add(CountRow, [(1, "J", "a", "upstream", 1, 0, 0)])
    ready.send(None)
    signal.pause()


def kill_a_writer(run_dir: Path) -> None:
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    writer = context.Process(target=_write_until_killed, args=(run_dir, send))
    writer.start()
    send.close()  # so that the end of a writer that failed is noticed
    receive.recv()
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()


def test_a_killed_writer_leaves_all_that_it_committed(tmp_path: Path) -> None:
    kill_a_writer(tmp_path)
    assert (tmp_path / f"{FILE_NAME}-wal").exists()
    with Run(tmp_path) as run:
        assert list(run.rows(CountRow)) == [(0, "J", "a", "upstream", 1, 0, 0)]


def test_a_running_recording_can_be_read(tmp_path: Path) -> None:
    database = Database(tmp_path)
    database.add(CountRow, [(0, "J", "a", "upstream", 1, 0, 0)])
    database.commit()
    with Run(tmp_path) as run:
        assert len(list(run.rows(CountRow))) == 1
    database.close()


def test_a_closed_recording_is_one_file(tmp_path: Path) -> None:
    Database(tmp_path).close()
    assert [p.name for p in tmp_path.iterdir()] == [FILE_NAME]


def test_column_names_carry_units_and_results_carry_no_clock() -> None:
    for table in RESULTS:
        clocks = [c for c in table.columns if c.endswith("_ns") and "sim_" not in c]
        assert not clocks, table.name
    assert len({table.name for table in TABLES.values()}) == len(TABLES)


def test_a_row_with_the_same_keys_is_replaced(tmp_path: Path) -> None:
    database = Database(tmp_path)
    for points in (None, 5):
        database.add(FrameRow, [FrameRow(3, *(None,) * 5, points, *(None,) * 5)])
        database.commit()
    database.close()
    with Run(tmp_path) as run:
        assert [r.points for r in run.rows(FrameRow)] == [5]


def test_a_row_that_does_not_fit_costs_itself_alone(tmp_path: Path) -> None:
    database = Database(tmp_path)
    database.add(
        CountRow, [(0, "J", "a", "upstream", 1 << 70, 0, 0), (1, "J", "a", "upstream", 1, 0, 0)]
    )
    database.close()
    assert database.refused_rows == 1
    with Run(tmp_path) as run:
        assert list(run.rows(CountRow)) == [(1, "J", "a", "upstream", 1, 0, 0)]


def test_runs_that_differ_only_in_clocks_have_the_same_results(tmp_path: Path) -> None:
    rows = [CountRow(frame, "J", "a", "upstream", frame, 0) for frame in range(5)]
    record(tmp_path / "a", rows, clock_ns=1)
    record(tmp_path / "b", rows[::-1], clock_ns=2)
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_a_differing_row_is_named(tmp_path: Path) -> None:
    rows = [CountRow(frame, "J", "a", "upstream", frame, 0) for frame in range(5)]
    record(tmp_path / "a", rows)
    record(tmp_path / "b", [*rows[:3], CountRow(3, "J", "a", "upstream", 9, 0)])
    (difference,) = differences(tmp_path / "a", tmp_path / "b")
    assert (difference.table, difference.rows_a, difference.rows_b) == ("counts", 5, 4)
    assert difference.differing == 2
    assert str(difference) == (
        "counts: 2 rows differ (5 against 4); "
        "first frame 3 tls J lane a side upstream: vehicles 3 against 9"
    )


def test_a_row_that_one_run_lacks_is_named(tmp_path: Path) -> None:
    rows = [CountRow(frame, "J", "a", "upstream", frame, 0) for frame in range(5)]
    for n in range(5):
        record(tmp_path / f"a{n}", rows[:n] + rows[n + 1 :])
        record(tmp_path / f"b{n}", rows)
        for pair, side in (("ab", "second"), ("ba", "first")):
            (difference,) = differences(*(tmp_path / f"{one}{n}" for one in pair))
            where = f"frame {n} tls J lane a side upstream"
            assert difference.first == f"{where}: only in the {side} run"
            assert difference.differing == 1


def test_long_values_that_differ_at_their_end_are_told_apart(tmp_path: Path) -> None:
    for name, points in (("a", 14), ("b", 15)):
        seen = json.dumps({f"vehicle_{n}": 100 for n in range(9)} | {"last": points})
        (tmp_path / name).mkdir()
        database = Database(tmp_path / name)
        database.add(SightingRow, [SightingRow(0, "agent", seen)])
        database.close()
    (difference,) = differences(tmp_path / "a", tmp_path / "b")
    assert difference.first.endswith('"last": 14} against …e_8": 100, "last": 15}')


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a run"):
        Run(tmp_path / "nowhere")
    (tmp_path / FILE_NAME).write_bytes(b"something else entirely" * 100)
    with pytest.raises(ConfigError, match="not a run's database"):
        Run(tmp_path)


def test_foreign_databases_and_versions_are_refused(tmp_path: Path) -> None:
    for name, statement in {"other": "CREATE TABLE x (y)", "newer": None}.items():
        run_dir = tmp_path / name
        run_dir.mkdir()
        if statement is None:
            Database(run_dir).close()
            statement = "UPDATE meta SET value = '99' WHERE key = 'schema_version'"
        connection = sqlite3.connect(run_dir / FILE_NAME)
        connection.execute(statement)
        connection.commit()
        connection.close()
    with pytest.raises(ConfigError, match="not a run's database"):
        Run(tmp_path / "other")
    with pytest.raises(ConfigError, match=f"version 99, this side reads 17 to {SCHEMA_VERSION}"):
        Run(tmp_path / "newer")


def test_what_an_older_run_lacks_is_read_as_null_and_not_compared(tmp_path: Path) -> None:
    trip = TripRow("a", 0, 0.0, 9.0, 4.0, 0, 1, 200.0)
    asked = RequestRow(1, "j", "Gr", "fixed", "[]", None, "", 0)
    for name in ("older", "newer"):
        (tmp_path / name).mkdir()
        database = Database(tmp_path / name)
        database.add(TripRow, [trip])
        database.add(RequestRow, [asked])
        database.close()
    connection = sqlite3.connect(tmp_path / "older" / FILE_NAME)
    for statement in (
        "ALTER TABLE requests DROP COLUMN wait_sim_ns",
        "ALTER TABLE trips DROP COLUMN stops",
        "ALTER TABLE trips DROP COLUMN co2_g",
        "UPDATE meta SET value = '17' WHERE key = 'schema_version'",
    ):
        connection.execute(statement)
    connection.commit()
    connection.close()
    with Run(tmp_path / "older") as run:
        assert list(run.rows(TripRow)) == [trip._replace(stops=None, co2_g=None)]
        assert list(run.rows(RequestRow)) == [asked._replace(wait_sim_ns=None)]
        assert run.query("SELECT avg(stops), sum(time_loss_s) FROM trips") == [(None, 4.0)]
    assert differences(tmp_path / "older", tmp_path / "newer") == []
    connection = sqlite3.connect(tmp_path / "older" / FILE_NAME)
    connection.execute("UPDATE trips SET time_loss_s = 5")
    connection.commit()
    connection.close()
    found = differences(tmp_path / "older", tmp_path / "newer")
    assert [one.first for one in found] == ["vehicle a: time_loss_s 5.0 against 4.0"]


def test_a_copy_without_its_wal_is_told_what_it_lacks(tmp_path: Path) -> None:
    sqlite3.connect(tmp_path / FILE_NAME).execute("PRAGMA journal_mode = wal").close()
    with pytest.raises(ConfigError, match=r"no such table: meta; .* in run\.sqlite-wal, which"):
        Run(tmp_path)


def test_a_missing_or_damaged_setup_is_named(tmp_path: Path) -> None:
    Database(tmp_path).close()
    with Run(tmp_path) as run:
        with pytest.raises(ConfigError, match=r"no setup\.msgpack"):
            _ = run.setup
        (tmp_path / "setup.msgpack").write_bytes(b"CPNT")
        with pytest.raises(ConfigError, match="cannot be read"):
            _ = run.setup


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        Database(tmp_path / "missing")


@pytest.mark.parametrize("scenario", ["[1, 2]", "no json", "{"])
def test_a_scenario_that_is_no_json_object_is_named(tmp_path: Path, scenario: str) -> None:
    database = Database(tmp_path)
    database.add(MetaRow, [MetaRow("scenario", scenario)])
    database.close()
    with Run(tmp_path) as run, pytest.raises(ConfigError, match=r"run\.sqlite: scenario in meta"):
        _ = run.scenario


def test_a_damaged_table_is_named_when_it_is_read(tmp_path: Path) -> None:
    database = Database(tmp_path)
    database._connection.execute("DROP TABLE counts")
    database.close()
    with Run(tmp_path) as run:
        with pytest.raises(ConfigError, match=r"run\.sqlite is not a run's database"):
            list(run.rows(CountRow))
        with pytest.raises(ConfigError, match="no such table"):
            run.query("SELECT * FROM counts")


def test_rows_of_a_kilobyte_share_pages(tmp_path: Path) -> None:
    sightings = [SightingRow(frame, "rsu-0", "x" * 1200) for frame in range(500)]
    database = Database(tmp_path)
    database.add(SightingRow, sightings)
    database.close()
    with Run(tmp_path) as run:
        ((size_bytes,),) = run.query("SELECT sum(pgsize) FROM dbstat WHERE name = 'sightings'")
    assert size_bytes < 1.5 * 1200 * len(sightings)
