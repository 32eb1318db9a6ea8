"""Drawings kept in a file: complete, or an error is raised."""

import shutil
import signal
from collections import namedtuple

import pytest

rr = pytest.importorskip("rerun", reason="the extra `view` is not installed")

from protocol.errors import ConfigError, CpnetError  # noqa: E402 - of use with the extra alone
from tests.viewer.shown import SETUP  # noqa: E402
from viewer import sinks  # noqa: E402
from viewer.scene import Scene  # noqa: E402
from viewer.sinks import free_port, opened  # noqa: E402

Usage = namedtuple("Usage", "total used free")
SCENE = Scene(SETUP)


@pytest.mark.parametrize("name", ["there.rrd", "new.txt", "new", ".", "none/new.rrd", "x" * 300])
def test_only_a_new_file_of_its_kind_is_written(tmp_path, name):
    (tmp_path / "there.rrd").write_text("precious")
    with pytest.raises(ConfigError, match="--save"), opened(None, tmp_path / name, SCENE):
        pass
    assert (tmp_path / "there.rrd").read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["there.rrd"]


def test_without_a_display_no_window_is_tried(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match="no window can open here"), opened(None, None, SCENE):
        pass


def test_a_page_is_served_until_the_end():
    with opened(free_port(), None, SCENE) as sink:
        assert sink.server.poll() is None
    assert sink.server.poll() is not None


def test_a_server_that_does_not_end_when_it_is_asked_to_is_killed(monkeypatch):
    monkeypatch.setattr(sinks, "_STOP_S", 0.1)
    with opened(free_port(), None, SCENE) as sink:
        monkeypatch.setattr(sink.server, "terminate", lambda: None)
    assert sink.server.returncode == -signal.SIGKILL


def test_a_name_that_is_too_long_is_refused(tmp_path):
    path = tmp_path / f"{'x' * 300}.rrd"
    with pytest.raises(ConfigError, match="--save"), opened(None, path, SCENE):
        pass


def test_what_was_drawn_is_in_the_file(tmp_path):
    with opened(None, tmp_path / "a.rrd", SCENE) as sink:
        sink.recording.log("a", rr.TextLog("said"))
    assert (tmp_path / "a.rrd").read_bytes().startswith(b"RRF")


def test_a_disk_that_failed_is_told_of(tmp_path, monkeypatch):
    def flush(*_, **__):
        raise RuntimeError("the writer has stopped")

    monkeypatch.setattr(rr.RecordingStream, "flush", flush)
    path = tmp_path / "a.rrd"
    with (
        pytest.raises(CpnetError, match=r"a\.rrd is not whole: the writer has stopped"),
        opened(None, path, SCENE),
    ):
        pass


def test_a_disk_that_is_full_at_the_end_is_told_of(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(9, 9, 0))
    with (
        pytest.raises(CpnetError, match=r"a\.rrd is not whole: 0 bytes of the disk are free"),
        opened(None, tmp_path / "a.rrd", SCENE),
    ):
        pass
