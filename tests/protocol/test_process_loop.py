import logging
import threading

import pytest

from protocol.errors import ConfigError, MessageError
from protocol.inbox import Inbox, Presence
from protocol.process import loop


class Fragile:
    """Fails on each item with its own error, and stops the loop once all were taken."""

    def __init__(self, errors: list[Exception], stop: threading.Event) -> None:
        self.errors = errors
        self.stop = stop

    def on(self, item: object) -> None:
        raise self.errors.pop(0)

    def poll(self) -> None:
        if not self.errors:
            self.stop.set()

    def close(self) -> None:
        """Holds nothing."""


def run(*errors: Exception) -> Inbox:
    inbox, stop = Inbox(), threading.Event()
    for _ in errors:
        inbox.put(Presence("edge", "edge", alive=True))
    loop(Fragile(list(errors), stop), inbox, stop)
    return inbox


def test_a_message_that_a_role_cannot_take_does_not_end_it(caplog: pytest.LogCaptureFixture):
    faults = [ValueError("v"), KeyError("k"), IndexError("i"), TypeError("t")]
    with caplog.at_level(logging.ERROR):
        inbox = run(*faults, MessageError("m"))
    assert inbox.drops == {"role_error": 4, "MessageError": 1}
    (record,) = [r for r in caplog.records if r.levelno == logging.ERROR]
    assert record.exc_info


def test_an_error_of_the_run_itself_ends_the_role():
    with pytest.raises(ConfigError):
        run(ConfigError("the disk is full"))
