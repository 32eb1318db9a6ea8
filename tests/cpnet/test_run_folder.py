"""A run's folder: made for a start, and taken back if nothing comes of it."""

from pathlib import Path

import pytest

from cpnet.run_folder import RunFolder
from protocol.errors import ConfigError


def filled(out: Path) -> RunFolder:
    folder = RunFolder.at(out, "name")
    (folder.make() / "logs").mkdir()
    (out / "setup.msgpack").write_bytes(b"x")
    return folder


def test_a_folder_that_was_made_is_removed_and_can_be_made_again(tmp_path):
    filled(tmp_path / "run").take_back()
    assert list(tmp_path.iterdir()) == []
    assert filled(tmp_path / "run").path == tmp_path / "run"


def test_an_empty_folder_that_was_there_stays_empty(tmp_path):
    (tmp_path / "run").mkdir()
    filled(tmp_path / "run").take_back()
    assert list(tmp_path.rglob("*")) == [tmp_path / "run"]


def test_a_folder_that_holds_something_is_not_touched(tmp_path):
    (tmp_path / "precious").write_text("data")
    with pytest.raises(ConfigError, match="not an empty folder"):
        RunFolder.at(tmp_path, "name")
    assert (tmp_path / "precious").read_text() == "data"


def test_without_a_name_the_folder_says_what_and_when():
    assert RunFolder.at(None, "town").path.name.startswith("town-2")
