"""What is on a tape, at a glance."""

from __future__ import annotations

from dataclasses import dataclass

from player.frames import CLOCK
from protocol.errors import ConfigError
from protocol.messages import Roster, SignalState, Tick, Truth
from protocol.sequence_window import SequenceWindow
from tape.reader import Tape

_VEHICLE = "vehicle-"


@dataclass(frozen=True, slots=True)
class Survey:
    """So many frames in a row, of which the tape may lack some; `vehicles` are processes."""

    frames: int
    vehicles: int
    has_truth: bool

    @classmethod
    def of(cls, tape: Tape) -> Survey:
        """Goes through a tape once.

        Raises:
            ConfigError: there is no frame on it, or it cannot be read.
        """
        horizon = SequenceWindow()
        times: set[int] = set()
        vehicles, has_truth = 0, False
        for item in tape.heard(["tick", "truth", "roster", CLOCK]):
            message = item.message
            if isinstance(message, SignalState):
                horizon.follow(message.frame)
            if isinstance(message, Tick | SignalState) and horizon.admits(message.frame):
                times.add(message.frame)
            has_truth |= isinstance(message, Truth)
            if isinstance(message, Roster):
                vehicles = max(vehicles, _number(item.parts.get("process", "")) + 1)
        if not times:
            raise ConfigError(
                f"{tape.path}: holds no frame, neither a tick nor a state of the signal"
            )
        return cls(max(times) - min(times) + 1, vehicles, has_truth)


def _number(process: str) -> int:
    number = process.removeprefix(_VEHICLE)
    return int(number) if process != number and number.isdigit() and len(number) < 4 else -1
