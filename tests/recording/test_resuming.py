"""An interrupted recording is resumed, and the gap is recorded."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError, MessageError
from recording.database import Database
from recording.frame_aggregator import FrameAggregator
from recording.limits import MAX_PROCESSES, MAX_REASONS
from recording.losses import DropCounts
from recording.run import Run
from recording.tables import DropRow, FrameRow, MetaRow, RequestRow


def frame_row(frame: int) -> FrameRow:
    return FrameRow(frame, *(None,) * (len(FrameRow._fields) - 1))


def break_off(run_dir: Path, *meta: MetaRow) -> None:
    database = Database(run_dir)
    database.add(MetaRow, [MetaRow("scenario", "{}"), *meta])
    database.add(FrameRow, [frame_row(39)._replace(sim_time_ns=3_900_000_000), frame_row(41)])
    database.add(RequestRow, [RequestRow(40, "tls", "G", "max_pressure", "[]", None, "", 0)])
    database.add(DropRow, [DropRow("edge", "late", 3)])
    database.commit()
    database._connection.close()  # as if it had been killed


def test_a_recording_of_the_same_scenario_is_gone_on_with(tmp_path: Path) -> None:
    break_off(tmp_path)
    database = Database(tmp_path, "{}")
    assert (database.last_frame, database.last_whole) == (41, 40)
    assert database.last_tick == (39, 3_900_000_000)  # of the later ones no tick was received
    assert database.known_drops() == [DropRow("edge", "late", 3)]
    database.add(FrameRow, [frame_row(50)])
    database.close()
    with Run(tmp_path) as run:
        assert [row.frame for row in run.rows(FrameRow)] == [39, 41, 50]


def test_a_new_recording_goes_on_after_nothing(tmp_path: Path) -> None:
    assert Database(tmp_path, "{}").last_frame is None


@pytest.mark.parametrize(
    ("scenario", "meta"), [('{"seed": 2}', []), ("{}", [MetaRow("end_reason", "finished")])]
)
def test_another_scenarios_recording_and_one_that_ended_are_left_alone(
    tmp_path: Path, scenario: str, meta: list[MetaRow]
) -> None:
    break_off(tmp_path, *meta)
    with pytest.raises(ConfigError, match=r"run\.sqlite exists; .* folder of its own"):
        Database(tmp_path, scenario)


def test_what_was_recorded_before_stays_as_it_is() -> None:
    aggregator = FrameAggregator(100_000_000, {})
    aggregator.tick(0, 0)
    aggregator.settle(0)
    with pytest.raises(MessageError, match="before the recorder broke off"):
        aggregator.note(0)
    assert aggregator.note(1).frame == 1


def test_the_first_tick_after_a_break_is_believed_if_it_goes_on_from_the_last() -> None:
    aggregator = FrameAggregator(100_000_000, {}, (999, 99_900_000_000))
    aggregator.settle(1000)
    assert aggregator.note(1002).frame == 1002  # before any tick: the recorder knows where it was
    assert aggregator.tick(1003, 100_300_000_000).frame == 1003
    with pytest.raises(MessageError, match="does not follow"):
        aggregator.tick(9000, 900_000_000_000)


@given(st.lists(st.lists(st.dictionaries(st.sampled_from("ab"), st.integers(0, 9)), max_size=4)))
def test_drops_add_up_over_restarts(lives: list[list[dict[str, int]]]) -> None:
    drops, expected = DropCounts(), Counter()
    for life in lives:
        total: Counter[str] = Counter()
        drops.received("p", {"since": 0})
        for more in life:
            total += Counter(more)
            drops.received("p", dict(total))
        drops.received("p", dict(total) | {"since": 1})  # so that each new life is seen to begin
        expected += total
    rows = {row.reason: row.times for row in drops.take_changed()}
    assert {k: n for k, n in rows.items() if n and k != "since"} == dict(expected)


def test_what_a_process_counts_on_is_not_counted_twice_after_the_recorders_own_restart() -> None:
    drops = DropCounts([DropRow("edge", "late", 3)])
    drops.received("edge", {"late": 5})
    assert drops.take_changed() == [DropRow("edge", "late", 5)]
    assert drops.take_changed() == []
    assert drops.total() == 5


def test_too_many_processes_are_not_remembered() -> None:
    drops = DropCounts()
    for number in range(MAX_PROCESSES):
        drops.received(str(number), {"late": 1})
    with pytest.raises(MessageError, match="one process more than"):
        drops.received("another", {"late": 1})
    assert drops.total() == MAX_PROCESSES


def test_reasons_stay_bounded_however_often_they_change() -> None:
    drops = DropCounts()
    for number in range(3 * MAX_REASONS):
        drops.received("p", {f"reason {number}": 1})
    assert len(drops.take_changed()) == MAX_REASONS
