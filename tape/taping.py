"""Taping as a whole: what was heard first, then what there is time for."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from protocol.courtesy import Budget
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import End, Setup
from protocol.onlooker import ALL_TOPICS
from protocol.version import own_version
from tape.ending import Ending
from tape.scene import BOXES_PER_CORE, CLOUDS_PER_CORE, Scene
from tape.writer import TapeWriter

REST_S = 0.2
"""Nobody waits for a tape: what comes meanwhile is taken together, for less work."""
TRUTH = frozenset({"truth", "sighting"})


@dataclass(frozen=True, slots=True)
class Choice:
    """What is taped: with the truth or without, for Foxglove as well or not."""

    truth: bool = True
    foxglove: bool = True

    @property
    def topics(self) -> frozenset[str]:
        """Names in the topic table."""
        return ALL_TOPICS if self.truth else ALL_TOPICS - TRUTH


class Taping:
    """Keeps what comes; a role, see `protocol.process.Role`."""

    def __init__(
        self,
        setup: Setup,
        next_path: Callable[[], Path],
        inbox: Inbox,
        choice: Choice,
        stop: threading.Event,
    ) -> None:
        """Begins a tape; `stop` is set once the run is over.

        Raises:
            ConfigError: the tape cannot be written there.
        """
        inbox.keep_encoded()
        inbox.gather()
        self._inbox = inbox
        self._stop = stop
        self._ending = Ending()
        self._reason = "unknown"
        self.writer = TapeWriter(next_path, setup, _facts(setup, choice))
        self.scene = _scene(setup, self.writer) if choice.foxglove else None

    @property
    def dropped(self) -> int:
        """How many messages came that are not on the tape."""
        return self._inbox.drops.total()

    def on(self, item: Envelope | Presence) -> None:
        """Keeps a message.

        Raises:
            ProtocolError: it cannot be kept.
            CpnetError: the disk is full, or fails.
        """
        if isinstance(item, Presence):
            self._ending.look(item, time.monotonic_ns())
            return
        end = item.message if item.topic == "end" else None
        moment = self.writer.write(item)
        self._ending.heard(time.monotonic_ns())
        if isinstance(end, End):
            self._reason = end.reason
            self._ending.begin(time.monotonic_ns())
        if self.scene is not None and moment.frame is not None:
            self.scene.take(item, moment.frame)

    def poll(self) -> None:
        """Does what is due when all that came was taken.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        while self.scene is not None and self._inbox.is_empty and self.scene.step():
            pass
        now_ns = time.monotonic_ns()
        self.writer.settle(now_ns)
        is_idle = self._inbox.is_empty
        if not is_idle:
            self._ending.heard(now_ns)
        if self._ending.is_over(now_ns):
            self._stop.set()
        elif is_idle:
            time.sleep(REST_S)

    def close(self) -> None:
        """Ends the tape.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        facts = {
            "end_reason": self._reason,
            "messages": str(self.writer.messages),
            "drops": json.dumps(self._inbox.drops),
        }
        if self.scene is not None:
            facts["frames_left_out"] = str(self.scene.frames_left_out)
            facts["clouds_left_out"] = str(self.scene.clouds_left_out)
        self.writer.close(facts)


def _scene(setup: Setup, writer: TapeWriter) -> Scene:
    now_ns = time.monotonic_ns()
    boxes, clouds = (
        Budget.of_this_machine(share, now_ns) for share in (BOXES_PER_CORE, CLOUDS_PER_CORE)
    )
    return Scene(setup, writer, boxes, clouds)


def _facts(setup: Setup, choice: Choice) -> dict[str, str]:
    scenario = setup.scenario
    told = {key: str(scenario.get(key, "")) for key in ("name", "mode", "seed", "region")}
    return told | {
        "cpnet": own_version(),
        "truth": json.dumps(choice.truth),
        "log_time": "when it arrived, on time.monotonic_ns of the process that taped",
        "publish_time": "simulated time; the log time where a message has none",
    }
