"""A user's mistake: one clear message, status 2, no traceback, nothing lost."""

import socket
from pathlib import Path

import pytest

from tests.cpnet.conftest import Shell


def refused(shell: Shell, *arguments: str) -> str:
    status, output = shell.run(*arguments)
    assert status == 2, output
    assert "Traceback" not in output
    return output


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
    assert "allowed: edge, sim" in refused(shell, "up", "--only", "edgy")


@pytest.mark.parametrize("command", ["report", "draw"])
def test_a_run_that_is_not_there(shell, command):
    assert "nothing" in refused(shell, command, "nothing")


def test_a_folder_without_a_run(shell, tmp_path):
    assert str(tmp_path) in refused(shell, "report", str(tmp_path)).replace("\n", "")


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
        (["out", "--moments=501"], "--moments 501: must be 1 to 500"),
        (["out", "--seed=-1"], "--seed -1: must be 0 to"),
        (["out", "--jobs=0"], "--jobs 0: must be 1 to"),
    ],
)
def test_a_dataset_that_cannot_be_made(shell, tmp_path, arguments, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious").write_text("data")
    (tmp_path / "file").write_text("")
    assert message in refused(shell, "dataset", *arguments)
    assert (tmp_path / "full" / "precious").read_text() == "data"
    assert not (tmp_path / "out").exists()
