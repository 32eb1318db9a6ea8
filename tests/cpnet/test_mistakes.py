"""A user's mistake: one clear message, status 2, no traceback, nothing lost."""

import socket
from pathlib import Path

import pytest

from tests.cpnet.commands import Shell


def refused(shell: Shell, *arguments: str) -> str:
    status, output = shell.run(*arguments)
    assert status == 2, output
    assert "Traceback" not in output
    return output


LONG = "x" * 5000  # longer than the name of a file can be


@pytest.mark.parametrize(
    "arguments",
    [
        "up --net",
        "up --sumocfg",
        "up --out",
        "up --link",
        "report",
        "draw",
        "bench codec --points",
        "eval --tracks",
        "track",
    ],
)
def test_a_name_that_no_file_can_have(shell, arguments):
    assert "x" * 70 in refused(shell, *arguments.split(), LONG)


def test_a_sumocfg_that_is_not_what_its_name_says(shell, tmp_path):
    (tmp_path / "own.sumocfg.gz").write_bytes(b"\x1f\x8b\x08\x00junk")
    assert "own.sumocfg.gz cannot be read" in refused(shell, "up", "--sumocfg", "own.sumocfg.gz")


def test_routes_without_their_net(shell):
    assert "--routes needs --net" in refused(shell, "up", "--routes", "own.rou.xml")


@pytest.mark.parametrize("command", ["top --once", "view", "eval"])
def test_two_signals_for_a_command_that_takes_one(shell, command):
    output = refused(shell, *command.split(), "--tls", "A", "--tls", "B")
    assert "--tls: A, B were given; this command takes one signal" in output


def test_a_report_where_there_is_no_run(shell):
    assert "there is no run in runs/" in refused(shell, "report")
    assert "there is no run in runs/" in refused(shell, "draw")


def test_an_unknown_key(shell):
    output = refused(shell, "up", "--set", "edge.cluster.epsilon_m=1")
    assert "unknown key edge.cluster.epsilon_m" in output
    assert "allows: eps_m, min_points" in output


def test_a_net_that_is_not_there(shell):
    output = refused(shell, "up", "--net", "nowhere.net.xml", "--tls", "J")
    assert "nowhere.net.xml" in output


def test_a_net_that_is_no_net(shell, tmp_path):
    (tmp_path / "broken.net.xml").write_text("<net><edge")
    output = refused(shell, "up", "--net", "broken.net.xml", "--tls", "J")
    assert "broken.net.xml" in output


def test_a_signal_that_the_net_lacks(shell):
    output = refused(shell, "up", "--tls", "K")
    assert "'K'" in output
    assert "J" in output


def test_of_signals_that_are_named_one_by_one_none_is_forgotten(shell):
    assert "no signal 'K'" in refused(shell, "up", "--tls", "K", "--tls", "J")
    assert "no signal 'K'" in refused(shell, "up", "--tls", "J,K")
    assert "1 junctions: 1 regions would have none" in refused(shell, "up", "--regions", "2")


@pytest.mark.parametrize("value", ["seed=2020-13-45", "seed=0b_", "name=../evil", "name=[/x]"])
def test_values_that_yaml_or_the_terminal_would_choke_on(shell, value):
    refused(shell, "up", "--set", value)


def test_two_mounts_of_one_name(shell):
    output = refused(shell, "up", "--set", "roadside_mounts=[{id: a}, {id: a, x_m: 9}]")
    assert "each may stand once" in output


@pytest.mark.parametrize("name", ["x" * 300, "[/x]", "a\nb"])
def test_a_scenario_that_no_file_can_be(shell, name):
    assert "no scenario" in refused(shell, "up", name)


def test_a_port_in_use(shell):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        output = refused(shell, "up", "--listen", f"v2x=127.0.0.1:{port}")
    assert f"port {port}: Address already in use" in output


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("", "needs PORT or HOST:PORT"),
        ("0", "with a port from 1 to 65535"),
        ("65536", "with a port from 1 to 65535"),
        ("metrics", "needs PORT or HOST:PORT"),
        ("127.0.0.1:", "needs PORT or HOST:PORT"),
        ("::1:9000", "needs PORT or HOST:PORT"),
        ("nowhere.invalid:9000", "cannot listen at nowhere.invalid:9000"),
        (f"{'x' * 80}:9000", "cannot listen at"),
        ("192.0.2.1:9000", "cannot listen at 192.0.2.1:9000: Cannot assign requested address"),
    ],
)
def test_a_place_where_no_metrics_can_be(shell, tmp_path, place, message):
    assert message in refused(shell, "up", "--metrics", place)
    assert list(tmp_path.iterdir()) == []


def test_a_port_for_metrics_that_is_in_use(shell, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        output = refused(shell, "up", "--metrics", str(port))
    assert f"cannot listen at 127.0.0.1:{port}: Address already in use" in output
    assert list(tmp_path.iterdir()) == []


def test_a_log_that_is_neither(shell):
    assert "--log" in refused(shell, "up", "--log", "xml")


def test_a_bus_that_the_doctor_cannot_look_for(shell):
    assert "needs HOST:PORT" in refused(shell, "doctor", "--connect", "nowhere")


def test_an_output_folder_that_holds_something(shell, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").write_text("data")
    assert "not an empty folder" in refused(shell, "up", "--out", "run")
    assert (tmp_path / "run" / "precious").read_text() == "data"


def test_an_output_folder_that_cannot_be_made(shell, tmp_path):
    (tmp_path / "file").write_text("")
    assert "--out" in refused(shell, "up", "--out", "file/run")


def test_scenario_options_where_the_world_is_elsewhere(shell):
    output = refused(shell, "up", "--only=vehicle", "--connect=127.0.0.1:1", "--seed=3")
    assert "decided where the role sim runs" in output


def test_a_role_that_does_not_exist(shell):
    assert "allowed: router, sim" in refused(shell, "up", "--only", "edgy")


def test_a_recording_that_is_not_there(shell, tmp_path):
    output = refused(shell, "up", "--set=recording=nowhere", "--set=traffic.warmup_s=0")
    assert "recording nowhere: " in output
    assert "recording.json" in output
    assert list(tmp_path.iterdir()) == [tmp_path / "runs"]
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.parametrize("link", ["5mbit,99999999ms", "nowhere.csv"])
def test_a_link_that_cannot_be(shell, link):
    assert "error link" in refused(shell, "up", "--link", link)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("uplink --link lte --link nowhere", "link 'nowhere': neither a file"),
        ("uplink --link lte --link lte", "--link: 'lte' stands 2 times, each may stand once"),
        ("uplink --policies full,nobody", "policy 'nobody': must be one of"),
        ("uplink --policies full,reap+sky", "filter 'sky' must be one of"),
        ("uplink --policies sharing --realtime", "virtual links, not in realtime"),
        ("rate --policies sharing", "virtual links, not in realtime"),
        ("rate --policies full,full", "--policies: 'full' stands 2 times"),
    ],
)
def test_a_measurement_that_cannot_be(shell, arguments, message):
    assert message in refused(shell, "bench", *arguments.split())


@pytest.mark.parametrize("command", ["report", "draw"])
def test_a_run_that_is_not_there(shell, command):
    assert "nothing" in refused(shell, command, "nothing")


def test_a_folder_without_a_run(shell, tmp_path):
    assert str(tmp_path) in refused(shell, "report", str(tmp_path)).replace("\n", "")


@pytest.mark.parametrize(
    ("file", "message"),
    [("folder", "is a folder; name a file"), ("none/run.html", "there is no folder none")],
)
def test_a_page_that_cannot_be_written(shell, tmp_path, file, message):
    (tmp_path / "folder").mkdir()
    assert message in refused(shell, "report", "nothing", "--html", file)


def test_a_refused_start_leaves_no_folder_behind(shell, tmp_path):
    refused(shell, "up", "--tls", "K", "--out", "run")
    assert not (tmp_path / "run").exists()
    assert list(Path(tmp_path).iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["full"], "not an empty folder"),
        (["file/out"], "Not a directory"),
        (["out", "--networks=0"], "--networks 0: must be 1 to 1000"),
        (["out", "--samples=501"], "--samples 501: must be 1 to 500"),
        (["out", "--seed=-1"], "--seed -1: must be 0 to"),
        (["out", "--jobs=0"], "--jobs 0: must be 1 to"),
        (["out", "--furniture=31"], "--furniture 31.0: must be 0 to 30"),
    ],
)
def test_a_dataset_that_cannot_be_made(shell, tmp_path, arguments, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious").write_text("data")
    (tmp_path / "file").write_text("")
    assert message in refused(shell, "dataset", *arguments)
    assert (tmp_path / "full" / "precious").read_text() == "data"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["up", "--set=edge.detector=pointpillars"],
        ["eval", "--net=nowhere", "--detectors=pointpillars"],
    ],
)
def test_weights_that_cannot_be_used_start_nothing(shell, tmp_path, arguments):
    pytest.importorskip("torch", reason="needs the extra `learn`")
    (tmp_path / "own").write_bytes(b"weights")
    output = refused(shell, *arguments, "--set=edge.pillars.weights=own")
    assert "weights own: is no whole safetensors file" in output
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("eval --tracks none", "none is not a run"),
        ("eval data --tracks none", "give neither a dataset nor --net"),
        ("eval data --truth none", "--truth goes with --tracks DIR --format kitti"),
        ("eval --tracks none --truth none", "--truth goes with --format kitti"),
        ("eval --tracks none --format kitti", "give the folder of the labels, --truth DIR"),
        ("eval --tracks none --format kitti --truth none", "must be a folder with a .txt file"),
        ("track none", "none: must be a folder with a .txt file"),
        ("track files --out files", "--out files: must be another folder"),
        ("track files", "files/0.txt: line 1: has 1 words, needs 15, 17 or 18"),
        ("track files --format run", "--format: must be kitti"),
        ("track files --poses none", "line 1: has 1 words"),
        ("report none --trajectories a.csv", "a.csv: must be the name of a .parquet file"),
        ("report none --trajectories a.parquet", "none is not a run"),
    ],
)
def test_tracks_that_cannot_be_measured_or_made(shell, tmp_path, command, message):
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "0.txt").write_text("what")
    assert message in refused(shell, *command.split())
