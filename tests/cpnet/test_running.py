"""How whoever looks on finds a run."""

import json
import os

import pytest

from cpnet import running
from cpnet.running import find, noted
from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.topics import BusName

BUSES = {
    BusName.V2X: Endpoint("tcp/0.0.0.0:7447", listen=True),
    BusName.WORLD: Endpoint("tcp/127.0.0.1:7448", listen=True),
}


def test_a_run_can_be_found_as_long_as_it_goes_on(tmp_path):
    with noted(tmp_path, BUSES, None):
        found = find(tmp_path, [], None)
        assert (found.v2x.locator, found.world.locator) == (
            "tcp/127.0.0.1:7447",
            "tcp/127.0.0.1:7448",
        )
        assert not found.v2x.listen
    with pytest.raises(ConfigError, match="no run goes on there"):
        find(tmp_path, [], None)


def test_a_folder_that_cannot_take_the_note_is_a_plain_mistake(tmp_path):
    gone = tmp_path / "gone"
    with pytest.raises(ConfigError, match="cannot be written"), noted(gone, BUSES, None):
        pass


def test_without_a_folder_it_is_the_newest_that_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "RUNS", tmp_path)
    with pytest.raises(ConfigError, match="no run goes on in"):
        find(None, [], None)
    for n, pid in enumerate((os.getpid(), os.getpid(), 2**22 + 1, 0, -5)):
        folder = tmp_path / str(n)
        folder.mkdir()
        path = folder / "buses.json"
        path.write_text(json.dumps({"v2x": "tcp/h:1", "world": "tcp/h:2", "pid": pid}))
        os.utime(path, (n, n))
    assert find(None, [], None).run_dir == tmp_path / "1"


def test_a_run_elsewhere_has_two_buses():
    found = find(None, ["host:7447"], None)
    assert (found.v2x.locator, found.world.locator) == ("tcp/host:7447", "tcp/host:7448")
    with pytest.raises(ConfigError, match="where is the world bus"):
        find(None, ["v2x=host:7447"], None)


def test_a_run_that_ends_while_it_is_looked_for_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "RUNS", tmp_path)
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "buses.json").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="no run goes on in"):
        find(None, [], None)


def test_a_name_that_no_folder_can_have_is_no_run(tmp_path):
    with pytest.raises(ConfigError, match="no run goes on there"):
        find(tmp_path / ("x" * 300), [], None)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"pid": "x"}'])
def test_a_damaged_note_is_no_run(tmp_path, text):
    (tmp_path / "buses.json").write_text(text)
    with pytest.raises(ConfigError, match="no run goes on there"):
        find(tmp_path, [], None)


def test_a_folder_and_a_place_are_one_too_many(tmp_path):
    with pytest.raises(ConfigError, match="not both"):
        find(tmp_path, ["host:7447"], None)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (None, "would start one"),
        ("run.sqlite", "it has ended: `cpnet report"),
        ("else", "it is no run folder"),
    ],
)
def test_what_can_be_done_instead_is_said(tmp_path, made, said):
    if made is not None:
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / made).touch()
    with pytest.raises(ConfigError, match=said):
        find(tmp_path / "run", [], None)
