"""Errors of `cpnet record` that cannot continue, or cannot start."""

from __future__ import annotations

import io
import signal
from contextlib import nullcontext
from pathlib import Path

import pytest
from rich.console import Console

from cpnet import observe
from cpnet.discovery import RunLocation
from protocol.bus import Endpoint
from protocol.errors import ConfigError, CpnetError
from protocol.inbox import Inbox
from protocol.observer import ALL_TOPICS
from tests.recording.mcap_rig import envelope, setup

pytest.importorskip("mcap", reason="needs the extra `mcap`")

from recording.mcap.reader import McapReader

NOWHERE = Endpoint("tcp/127.0.0.1:1", listen=False)


class Silent:
    """An observer that receives nothing."""

    def __init__(self) -> None:
        self.inbox = Inbox()

    def setup(self):
        return setup()

    def subscribe(self, topics):
        assert topics == ALL_TOPICS


def test_a_full_disk_leaves_what_can_be_read_and_says_so(tmp_path, monkeypatch):
    def loop(role, *_):
        role.on(envelope("tick", 1))
        raise CpnetError("record.mcap cannot be written: No space left on device")

    monkeypatch.setattr(observe, "Observer", lambda *_, **__: nullcontext(Silent()))
    monkeypatch.setattr(observe, "loop", loop)
    monkeypatch.setattr(observe, "lower_priority", lambda: None)
    printed = io.StringIO()
    before = signal.getsignal(signal.SIGTSTP)
    try:
        run = RunLocation(NOWHERE, NOWHERE, tmp_path)
        with pytest.raises(CpnetError, match="No space left"):
            observe.record_run(run, None, None, Console(file=printed, width=200), truth=True)
    finally:
        signal.signal(signal.SIGTSTP, before)
    assert (
        f"readable as far as it goes: {tmp_path / 'record.mcap'}: 1 messages" in printed.getvalue()
    )
    assert len([*McapReader(tmp_path / "record.mcap").messages(["tick"])]) == 1


@pytest.mark.parametrize(
    "name", ["a", f"{'x' * 300}.mcap", f"{'x' * 5000}.mcap", "there.mcap", "none/a.mcap"]
)
def test_what_cannot_be_a_new_file_is_refused_before_all_else(tmp_path, monkeypatch, name):
    (tmp_path / "there.mcap").touch()
    with pytest.raises(ConfigError, match="--out"):
        observe.record_run(
            RunLocation(NOWHERE, NOWHERE),
            tmp_path / Path(name),
            None,
            Console(quiet=True),
            truth=True,
        )
