"""`cpnet replay`: a recorded run once more, with the same scans and other edges, links, signals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from cpnet import scenario as scenarios
from cpnet.preparation import Played
from player.survey import Survey
from protocol.errors import ConfigError
from protocol.messages import Setup
from protocol.version import own_version
from tape.reader import Tape

LIVE = ("edge", "signal", "cabinet", "link", "record")
"""Sections that a replay may change: what is not on the tape."""
LIVE_KEYS = ("name", "duration_s", "traffic.start_timeout_s")
_PACE = ("mode", "replay")
_FITS = {"lockstep": "virtual", "realtime": "emulated"}


@dataclass(frozen=True, slots=True)
class Pace:
    """How a tape is played: in a mode, None for that of the recording; in realtime at a speed."""

    mode: Literal["lockstep", "realtime"] | None = None
    speed: float = 1.0

    @classmethod
    def of(cls, speed: float | None, *, lockstep: bool) -> Pace:
        """Reads `--speed` and `--lockstep`.

        Raises:
            ConfigError: both were given.
        """
        if lockstep and speed is not None:
            raise ConfigError("--lockstep has no speed: give it or --speed, not both")
        if lockstep:
            return cls("lockstep")
        return cls() if speed is None else cls("realtime", speed)


def played_tape(path: Path, overrides: dict[str, Any], pace: Pace, console: Console) -> Played:
    """Returns the replay of a tape, and says what of it cannot be read; see `setup_of`."""
    setup = setup_of(path, overrides, pace)
    if damaged := setup.scenario["replay"]["damaged"]:
        frames = round(setup.scenario["duration_s"] / setup.scenario["frame_period_s"])
        parts = "1 part" if damaged == 1 else f"{damaged} parts"
        console.print(
            f"{path}: the tape is damaged or was cut off: {parts} cannot be read; "
            f"{frames} frames are played",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    return Played(setup.scenario["name"], lambda _: setup)


def setup_of(path: Path, overrides: dict[str, Any], pace: Pace) -> Setup:
    """Returns what every process of a replay is given.

    Raises:
        ConfigError: there is no tape, or something is to be changed that is on it.
    """
    check_overrides(overrides)
    tape = Tape(path)
    survey = Survey.of(tape)
    data = tape.setup.scenario
    most_s = survey.frames * float(data["frame_period_s"])
    facts: dict[str, Any] = {
        "replay": {"tape": str(path.resolve()), "speed": pace.speed, "damaged": _damaged(tape)},
        "duration_s": most_s,
        "processes.vehicle": max(survey.vehicles, 1),
        "record.tape": False,
    }
    if pace.mode is not None:
        facts["mode"] = pace.mode
        if data["link"]["apply"] not in ("auto", "none", _FITS[pace.mode]):
            facts["link.apply"] = "auto"
    if not survey.has_truth:
        facts["record.truth"] = False
    scenario = scenarios.changed(data, {**facts, **overrides}, str(path))
    if scenario.duration_s > most_s:
        raise ConfigError(f"duration_s is {scenario.duration_s:g}, the tape has {most_s:g} s")
    _check_cabinet(scenario)
    changed = {"scenario": scenario.model_dump(mode="json"), "version": own_version()}
    return tape.setup.model_copy(update=changed)


def _damaged(tape: Tape) -> int:
    """Returns how many parts of a tape that was gone through cannot be read.

    An end that is missing is one: nobody can know how much would have followed.
    """
    return tape.drops.total() or int(not tape.is_whole)


def check_overrides(overrides: dict[str, Any]) -> None:
    """Refuses what would not change anything, because it is on the tape.

    Raises:
        ConfigError: there is such a key.
    """
    for key in overrides:
        section = key.partition(".")[0]
        if section in _PACE:
            raise ConfigError(f"{key}: a replay takes --lockstep or --speed N instead")
        if section not in LIVE and key not in LIVE_KEYS:
            raise ConfigError(
                f"{key}: what it decides is on the tape already, so a replay cannot change it. "
                f"Simulate the run anew with `cpnet up` and this key. A replay takes "
                f"{', '.join(f'{name}.*' for name in LIVE)}, {', '.join(LIVE_KEYS)}"
            )


def _check_cabinet(scenario: scenarios.Scenario) -> None:
    if scenario.cabinet.control == "actuated":
        raise ConfigError(
            "the signal of this run was SUMO's own actuated control, and a replay has no loop "
            "detectors: add --set cabinet.control=requests"
        )
