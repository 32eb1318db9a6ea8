"""The section of a run's page about its traffic."""

from pathlib import Path

from recording.run import Run
from studies.page.model import Chart, Section, Table, Text, flattened
from studies.trajectory_section import trajectory_section
from tests.studies.tracked_runs import make_queue_run, make_run


def section_of(run_dir: Path) -> Section:
    with Run(run_dir) as run:
        return trajectory_section(run)


def test_a_queue_that_starts_is_told_of_in_every_table(tmp_path: Path) -> None:
    make_queue_run(tmp_path)
    blocks = flattened(section_of(tmp_path).blocks)
    tables = {one.caption: one.rows for one in blocks if isinstance(one, Table)}
    assert tables["Queues at the start of green"] == (("in", 2, 3.5, 7, 23.0, 46.0),)
    assert tables["Turning movements"][0][:4] == ("in", "out", "through", 8)
    assert tables["Saturation flow, behind the first 4 of a queue"] == (("in", 3, 1800.0),)
    assert tables["Arrivals on green"] == (("in", 1, 100.0, 20.0),)
    assert [
        row[:2]
        for row in tables[
            "Mean speeds, standing included; a vehicle lost and found again is two tracks"
        ]
    ] == [("in", 8), ("out", 8)]
    assert [one.title for one in blocks if isinstance(one, Chart)] == [
        "Speeds by lane", "Queues at the start of green",
        "Headways of queued vehicles over the stop bar", "Arrivals in the cycle",
    ]  # fmt: skip


def test_a_run_without_signal_states_says_what_is_missing(tmp_path: Path) -> None:
    make_run(tmp_path)
    words = [one.text for one in flattened(section_of(tmp_path).blocks) if isinstance(one, Text)]
    assert len(words) == 4
    assert words[0].startswith("No lane was seen to get green")


def test_a_run_without_tracks_has_no_trajectories(tmp_path: Path) -> None:
    make_run(tmp_path, track=0)
    (block,) = section_of(tmp_path).blocks
    assert isinstance(block, Text)
    assert "the run has no tracks" in block.text
