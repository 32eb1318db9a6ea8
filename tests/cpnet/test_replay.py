"""A run that was recorded, played again: as it was, and to others."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap", reason="needs the extra `mcap`")

from rich.console import Console
from typer.testing import CliRunner

from cpnet import scenario as scenarios
from cpnet.cli import app
from cpnet.replay import Pace, replay_of_recording, setup_of
from protocol.errors import ConfigError
from recording.run import Run, differences
from recording.tables import (
    DetectionRow,
    FrameRow,
    LatencyRow,
    RequestRow,
    SightingRow,
    StageRow,
    TruthRow,
    UploadRow,
)
from studies.in_process import run_setup_in_process
from studies.summary import summarise
from tests.cpnet.commands import Shell, free_ports

REAP = ["upload.policy=reap", "link.profile=300kbit,20ms", "link.roadside_profile=lte"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Returns a run over virtual links that are too slow for all of the agents' chunks."""
    shell = Shell(tmp_path_factory.mktemp("recorded"))
    settings = [f"--set={setting}" for setting in REAP]
    status, output = shell.up(
        "--duration=3", "--record", "--cav-rate=0.1", "--cv-rate=0.1", "--out=run", *settings
    ).finish()
    assert status == 0, output
    return shell.folder / "run"


def solo(recorded: Path, folder: Path, *settings: str) -> Path:
    overrides = dict(scenarios.parse_assignment(setting) for setting in settings)
    folder.mkdir()
    run_setup_in_process(setup_of(recorded, overrides, Pace()), folder)
    return folder


def rows(run_dir: Path, table: type) -> list:
    with Run(run_dir) as run:
        return [*run.rows(table)]


def sent_by(run_dir: Path) -> list:
    """Returns what each chunk took, but those of the end, which no plan may cover yet."""
    sent = [row for row in rows(run_dir, UploadRow) if row.frame < 28]
    return [(row.agent, row.chunk, row.payload_bytes, row.link_sim_ns) for row in sent]


def test_with_its_own_settings_every_result_is_the_same(shell, recorded):
    status, output = shell.run("replay", str(recorded), "--out", "again")
    assert status == 0, output
    assert "router, sim, record, edge, signal, infra, vehicle" in output
    status, output = shell.run("report", str(recorded), "--against", "again")
    assert (status, output.splitlines()[-1]) == (0, "the results are the same, row for row")
    again = shell.folder / "again"
    sent = [sent_by(run) for run in (recorded, again)]
    assert sent[0] == sent[1]
    sensed = [sum(row.sense_ns for row in rows(run, LatencyRow)) for run in (recorded, again)]
    assert sensed[0] == sensed[1] > 0
    assert json.loads((again / "scenario.json").read_text())["replay"]["recording"] == str(recorded)


def test_edge_and_signal_may_be_elsewhere(shell, recorded):
    port = free_ports()
    here = shell.start(
        *("replay", str(recorded), "--only=sim,vehicle,infra,record", "--out=here"),
        *(f"--listen=world=127.0.0.1:{port + 1}", f"--connect=v2x=127.0.0.1:{port}"),
    )
    there = shell.start(
        *("up", "--only=router,edge,signal", "--out=there"),
        *(f"--listen=v2x=127.0.0.1:{port}", f"--connect=world=127.0.0.1:{port + 1}"),
    )
    for command in (here, there):
        status, output = command.finish()
        assert status == 0, output
    assert differences(recorded, shell.folder / "here") == []


def test_a_replay_is_begun_where_the_recording_is(shell, recorded):
    status, output = shell.run("replay", str(recorded), "--only=edge")
    assert (status, "a replay is begun where the role sim runs" in output) == (2, True)


@pytest.mark.parametrize(
    ("setting", "phases"),
    [
        ("signal.policy=predictive", 3),
        ("signal.phases=compatible", 3),
        ("signal.policy=fixed", 2),
        ("edge.deadline_ms=70", 2),
    ],
)
def test_another_policy_has_the_phases_that_it_asks_for(recorded, setting, phases):
    setup = setup_of(recorded, dict([scenarios.parse_assignment(setting)]), Pace())
    assert len(setup.road_map.intersections[0].signal.greens) == phases


def test_over_another_link_more_arrives(tmp_path, recorded):
    faster = solo(recorded, tmp_path / "faster", "link.profile=none", "link.roadside_profile=none")
    used = [sum(row.points or 0 for row in rows(run, FrameRow)) for run in (recorded, faster)]
    assert used[1] > used[0]


def test_over_a_slower_link_less_is_sent(tmp_path, recorded):
    slower = solo(recorded, tmp_path / "slower", "link.profile=60kbit,20ms", "duration_s=1")
    sent = [
        sum(row.agent != "rsu-0" and row.frame < 10 for row in rows(run, UploadRow))
        for run in (recorded, slower)
    ]
    assert 0 < sent[1] < sent[0]


def test_of_a_recording_that_was_cut_off_all_are_told_and_it_is_counted_once(
    tmp_path, recorded, capsys
):
    whole = (recorded / "run.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    setup = replay_of_recording(cut, {}, Pace(), Console()).setup(tmp_path)
    frames = round(setup.scenario["duration_s"] * 10)
    warning = f"cut off: 1 part cannot be read; {frames} frames are played"
    assert warning in capsys.readouterr().out
    assert 5 < frames < 30
    run_dir = solo(cut, tmp_path / "played")
    summary = summarise(run_dir)
    counts = [
        reasons.get("damaged_in_recording", 0) for reasons in summary["drops_by_reason"].values()
    ]
    assert sum(counts) == 1
    assert summary["frames"] == frames
    replay_of_recording(recorded, {}, Pace(), Console())
    assert capsys.readouterr().out == ""


def test_another_detector_finds_others_in_the_same_scans(tmp_path, recorded):
    other = solo(
        recorded,
        tmp_path / "other",
        "edge.cluster.min_points=9",
        "signal.policy=fixed",
        "duration_s=2",
    )
    assert {row.policy for row in rows(other, RequestRow)} == {"fixed"}
    for table, is_same in ((TruthRow, True), (SightingRow, True), (DetectionRow, False)):
        before = [row for row in rows(recorded, table) if row.frame < 20]
        assert (rows(other, table) == before) is is_same


def test_in_realtime_a_recording_goes_as_fast_as_asked(shell, recorded):
    status, output = shell.run("replay", str(recorded), "--speed=2", "--set=link.profile=none",
                               "--set=link.roadside_profile=none", "--out=fast")  # fmt: skip
    assert status == 0, output
    assert json.loads(shell.run("report", "fast", "--json")[1])["frames"] == 30
    stages = [row for row in rows(shell.folder / "fast", StageRow) if row.stage == "world"]
    assert [row.frame for row in stages] == list(range(30))
    ends_ns = np.array([row.start_ns for row in stages])  # of frames, by the world's own clock
    # A frame that is less than a period late is made up for, one that is later shifts all others:
    # N frames take more than N - 1 periods of 50 ms, however late any of them is.
    for count in range(1, 30):
        assert (ends_ns[count:] - ends_ns[:-count]).min() > (count - 1) * 50e6, count
    assert (ends_ns[10:] - ends_ns[:-10]).min() < 9 * 100e6, "no faster than the recording"


@pytest.mark.parametrize(
    ("options", "error_text"),
    [
        (["none"], "there is no such recording, neither a file nor"),
        ([], "give the recording that is to be played, or --scans DIR --poses FILE"),
        (["{recording}", "--scans=x"], "--scans DIR --poses FILE; not both"),
        (["{recording}", "--frames=3"], "needs --scans DIR"),
        (["{recording}", "--refine"], "needs --scans DIR"),
        (["{recording}", "--width=30"], "needs --scans DIR"),
        (["--scans=x"], "--scans needs --poses FILE"),
        (["--scans=x", "--poses=y", "--refine"], "--refine needs --extrinsics FILE"),
        (["{recording}", "--lockstep", "--speed=2"], "--lockstep has no speed"),
        (
            ["{recording}", "--set=upload.policy=full"],
            "upload.policy: it is part of the recording already",
        ),
        (["{recording}", "--set=seed=2"], "seed: it is part of the recording already"),
        (
            ["{recording}", "--set=mode=realtime"],
            "mode: a replay takes --lockstep or --speed N instead",
        ),
        (["{recording}", "--set=duration_s=9"], "duration_s is 9, the recording has 3 s"),
        (["{recording}", "--set=cabinet.control=actuated"], "add --set cabinet.control=requests"),
        (
            ["{recording}", "--set=edge.detecter=fast"],
            "unknown key edge.detecter; did you mean detector",
        ),
    ],
)
def test_what_cannot_be_played_is_said(recorded, options, error_text):
    asked = CliRunner().invoke(
        app, ["replay", *(word.format(recording=recorded) for word in options)]
    )
    assert isinstance(asked.exception, ConfigError)
    assert error_text in str(asked.exception)


def test_a_mistake_is_said_in_a_line_and_leaves_nothing_behind(shell):
    status, output = shell.run("replay", "none")
    assert status == 2
    assert "there is no such recording" in output
    assert "Traceback" not in output
    assert not (shell.folder / "runs").exists()


def test_a_scenario_of_a_replay_is_not_simulated(tmp_path, recorded):
    saved = json.loads((recorded / "scenario.json").read_text())
    saved["replay"] = {"recording": str(recorded), "speed": 1.0}
    (tmp_path / "saved.yaml").write_text(json.dumps(saved))
    asked = CliRunner().invoke(app, ["up", str(tmp_path / "saved.yaml")])
    assert "that is played by `cpnet replay" in str(asked.exception)
