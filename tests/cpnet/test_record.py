"""Runs that are recorded: from their start, or by `cpnet record` later."""

import json
import os
import re
import signal
import sqlite3
from itertools import chain
from pathlib import Path

import pytest

pytest.importorskip("mcap", reason="needs the extra `mcap`")

from mcap.reader import make_reader

from protocol.errors import ConfigError
from recording.mcap.format import CLOSING_METADATA
from recording.mcap.reader import McapReader
from recording.rows import count_rows, detection_rows, phase_row, request_row, truth_rows
from recording.run import Run
from recording.tables import (
    CountRow,
    DetectionRow,
    FrameRow,
    PhaseRow,
    RequestRow,
    TruthRow,
    UploadRow,
)
from tests.cpnet.commands import children_of


def test_a_recording_holds_the_messages_that_the_database_was_made_of(shell):
    status, output = shell.up("--duration=5", "--record", "--out=run").finish()
    assert status == 0, output
    assert "sim, record, mcap, edge, signal" in output
    recording = McapReader(shell.folder / "run")
    recorded: dict[str, list] = {}
    for item in recording.messages():
        recorded.setdefault(item.topic, []).append(item.message)
    assert (recording.is_whole, recording.drops.total()) == (True, 0)
    assert [end.reason for end in recorded["end"]] == ["finished"]
    made = {
        PhaseRow: map(phase_row, recorded["state"]),
        RequestRow: map(request_row, recorded["request"]),
        DetectionRow: chain.from_iterable(detection_rows(m, "r0") for m in recorded["detections"]),
        CountRow: chain.from_iterable(map(count_rows, recorded["lanes"])),
        TruthRow: chain.from_iterable(map(truth_rows, recorded["truth"])),
    }
    with Run(shell.folder / "run") as run:
        frames = [row.frame for row in run.rows(FrameRow)]
        assert [tick.frame for tick in recorded["tick"]] == frames == [*range(50)]
        for table, rows in made.items():
            assert sorted(rows) == sorted(run.rows(table)), table
        assert len(recorded["scan"]) == len([*run.rows(UploadRow)])


def frames_on(recording: Path, kind: str = "tick") -> list[int]:
    """Returns the frames of a kind that can be read from a recording that may still grow."""
    try:
        return [item.message.frame for item in McapReader(recording).messages([kind])]
    except ConfigError:  # not so far yet
        return []


def drops_on(path: Path) -> int:
    """Returns how many messages a recording lacks by its metadata: those it was too slow for."""
    with path.open("rb") as file:
        closing = [one for one in make_reader(file).iter_metadata() if one.name == CLOSING_METADATA]
    return sum(json.loads(closing[0].metadata["drops"]).values())


def test_the_run_goes_on_when_the_mcap_recorder_is_killed(shell):
    command = shell.up("--mode=realtime", "--duration=10", "--record", "--out=run")
    command.read_until("vehicles")
    run_dir = shell.folder / "run"
    command.wait_until(lambda: len(frames_on(run_dir)) > 5)  # in realtime, for no run that is over
    os.kill(children_of(run_dir)["mcap"], signal.SIGKILL)
    command.read_until("mcap was killed by SIGKILL; the run goes on without it")
    status, output = command.finish()
    assert status == 1
    assert "the recording is not whole: mcap was killed by SIGKILL" in output
    assert "Traceback" not in output
    with sqlite3.connect(run_dir / "run.sqlite") as database:
        assert database.execute("SELECT count(*) FROM frames").fetchone() == (100,)
    seen = frames_on(run_dir)
    assert seen == [*range(len(seen))]
    assert len(seen) > 5
    assert not McapReader(run_dir).is_whole


def test_a_recording_is_started_again_and_others_come_and_go(shell):
    run_dir = shell.folder / "runs" / "a"
    options = ["--duration=600", "--mode=realtime", "--restart", "--record", f"--out={run_dir}"]
    command = shell.up(*options)
    command.read_until("vehicles")
    os.kill(children_of(run_dir)["mcap"], signal.SIGKILL)
    command.read_until("mcap was killed by SIGKILL; started again")
    to_the_end = shell.start("record", str(run_dir), "--no-truth")
    to_the_end.read_until("Ctrl-C ends it")
    until_signalled = shell.start("record", "--out=mine.mcap")  # the newest run
    until_signalled.read_until("Ctrl-C ends it")
    status, output = shell.run("record", "--duration=1")
    assert status == 0, output
    until_signalled.wait_until(lambda: frames_on(shell.folder / "mine.mcap", "detections"))
    until_signalled.process.send_signal(signal.SIGINT)
    for name in ("run-2.mcap", "record.mcap"):
        to_the_end.wait_until(lambda name=name: frames_on(run_dir / name, "detections"))
    command.process.send_signal(signal.SIGINT)
    assert command.finish()[0] == 130
    for command, name in ((to_the_end, run_dir / "record.mcap"), (until_signalled, "mine.mcap")):
        status, output = command.finish()
        assert status == 0, output
        dropped = re.search(r"(\d+) dropped", output)  # 0, if the machine is not too slow
        assert dropped is not None, output
        assert int(dropped[1]) == drops_on(shell.folder / name)
    ticks = [item.message.frame for item in McapReader(run_dir).messages(["tick"])]
    assert ticks == sorted(set(ticks))
    names = (run_dir / "record.mcap", shell.folder / "mine.mcap", run_dir / "record-2.mcap")
    recordings = [McapReader(path) for path in (run_dir / "run-2.mcap", *names)]
    assert all(recording.is_whole for recording in recordings)
    # record-2 has one second, in which a slow machine's edge may finish no frame
    assert all([*recording.messages(["detections"])] for recording in recordings[:-1])
    assert [item.message.reason for item in recordings[1].messages(["end"])] == ["stopped"]
    assert not [*recordings[1].messages(["truth", "sighting"])]


@pytest.mark.parametrize(
    ("arguments", "error_text"),
    [
        (["record"], "no run goes on in runs/"),
        (["record", "nowhere"], "nowhere: no run goes on there"),
        (["record", "run", "--connect", "h:1"], "give a run folder or --connect, not both"),
        (["up", "--only=router,sim,edge,mcap"], "--only mcap: the scenario has record.mcap false"),
    ],
)
def test_what_cannot_be_recorded_is_said(shell, arguments, error_text):
    status, output = shell.run(*arguments)
    assert (status, "Traceback" in output) == (2, False)
    assert error_text in output
