"""Plain functions as plug-ins: detector, upload policy, fusion, controller.

A function gets neither configuration nor road; parts that need them, or state for each signal or
agent, are given as an entry point would name them (a class or `Policy`), see docs/plugins.md.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from edge_server.config import FUSIONS, FusionConfig
from edge_server.fusion import FusionMaker
from perception.arrays import Bools, Bytes, Floats
from perception.config import DETECTORS
from perception.detector import Cloud, DetectorMaker, Stage, Vehicles, untimed
from perception.roadway import Roadway
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import AgentPose
from protocol.plugins import OWN
from protocol.roadmap import Signal
from protocol.scans import RangeScan, ScanPattern
from sensing.config import UploadConfig
from sensing.upload_policies import NAMES, Policy
from sensing.upload_selection import NOT_SENT
from signal_controller.config import POLICIES, SignalConfig
from signal_controller.observation import Observation, SignalSite
from signal_controller.policies import Decision, PolicyMaker

OwnDetector: TypeAlias = Callable[[Cloud], Floats | Vehicles] | DetectorMaker
"""Cloud to boxes (N, 7), or (N, 8) with a score from 0 to 1 at the end, or `Vehicles`.

Boxes are x, y, z of the centre, length, width, height in m and yaw in rad, map frame.
"""
OwnUpload: TypeAlias = Callable[[RangeScan, SE3], Bools] | Policy
"""Scan and estimated `map_SE3_sensor` to the beams (channels, columns) that are sent."""
OwnFusion: TypeAlias = Callable[[Vehicles, list[AgentPose]], Vehicles] | FusionMaker
"""Detections and the agents' poses to the vehicles of the frame, without duplicates."""
OwnController: TypeAlias = Callable[[Observation, Signal], int | str] | PolicyMaker
"""Observation and signal to a green: an index into `signal.greens`, or a state of links."""


@dataclass(frozen=True, slots=True)
class OwnParts:
    """Functions of the calling program; None leaves a part to the scenario."""

    detector: OwnDetector | None = None
    upload_policy: OwnUpload | None = None
    fusion: OwnFusion | None = None
    controller: OwnController | None = None

    def settings(self) -> dict[str, Any]:
        """Returns the scenario keys that name them."""
        return {key: name for key, _, name, _ in self._rows()}

    def plugins(self) -> dict[tuple[str, str], Any]:
        """Returns them as plug-ins, by group and name, for `protocol.plugins.provided`."""
        return {(group, name): plugin for _, group, name, plugin in self._rows()}

    def _rows(self) -> list[tuple[str, str, str, Any]]:
        parts: Mapping[str, tuple[str, Any, Callable[[Any], Any]]] = {
            "edge.detector": (DETECTORS.group, self.detector, _detector_maker),
            "upload.policy": (NAMES.group, self.upload_policy, _upload_policy),
            "edge.fusion.rule": (FUSIONS.group, self.fusion, _fusion_maker),
            "signal.policy": (POLICIES.group, self.controller, _policy_maker),
        }
        return [
            (key, group, _name(key, part), part if _is_maker(part) else made(part))
            for key, (group, part, made) in parts.items()
            if part is not None
        ]


def _is_maker(part: object) -> bool:
    return isinstance(part, type | Policy)


def _name(key: str, part: object) -> str:
    """Returns the name by which a scenario calls it."""
    if not callable(part) and not isinstance(part, Policy):
        what = f"a {type(part).__name__} was given"
        if isinstance(part, str):
            raise ConfigError(
                f"{key}: {what}, must be a function; a name is a key of the scenario: "
                f'**{{"{key}": {part!r}}}'
            )
        raise ConfigError(f"{key}: {what}, must be a function")
    return f"{OWN}{getattr(part, '__name__', type(part).__name__)}"


def _detector_maker(function: Callable[[Cloud], Floats | Vehicles]) -> DetectorMaker:
    return lambda config, roadway: _FunctionDetector(function)  # noqa: ARG005


@dataclass(frozen=True, slots=True)
class _FunctionDetector:
    function: Callable[[Cloud], Floats | Vehicles]

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:  # noqa: ARG002
        """See `Detector.detect`."""
        with stage("detect"):
            found = self.function(cloud)
        if isinstance(found, Vehicles):
            return found
        rows = _numbers(found)
        if rows is not None and rows.size == 0:
            rows = rows.reshape(0, 7)
        if rows is None or rows.ndim != 2 or rows.shape[1] not in (7, 8):
            raise _wrong(
                "detector",
                self.function,
                f"returned {_shown(found)}, must return boxes (N, 7), with scores (N, 8), "
                "or Vehicles",
            )
        if not np.isfinite(rows).all():
            raise _wrong("detector", self.function, "returned boxes with NaN or infinity")
        scores = rows[:, 7] if rows.shape[1] == 8 else np.ones(len(rows))
        return Vehicles.from_lidar(rows[:, :7], scores)


def _upload_policy(function: Callable[[RangeScan, SE3], Bools]) -> Policy:
    def chooser(config: UploadConfig, roadway: Roadway, pattern: ScanPattern) -> _FunctionChooser:  # noqa: ARG001
        return _FunctionChooser(function)

    return Policy("a function of the program that runs it", chooser=chooser)


@dataclass(frozen=True, slots=True)
class _FunctionChooser:
    function: Callable[[RangeScan, SE3], Bools]

    def choose(self, scan: RangeScan, map_SE3_sensor: SE3) -> Bytes:
        """See `Chooser.choose`."""
        found = self.function(scan, map_SE3_sensor)
        sent = np.asarray(found) if isinstance(found, np.ndarray | list) else np.zeros(0)
        if sent.dtype != np.bool_ or sent.shape != scan.range_m.shape:
            raise _wrong(
                "upload policy",
                self.function,
                f"returned {_shown(found)}, must return a mask of bool {scan.range_m.shape}; "
                "whoever has several chunks gives a Policy",
            )
        return np.where(sent, 0, NOT_SENT).astype(np.uint8)


def _fusion_maker(function: Callable[[Vehicles, list[AgentPose]], Vehicles]) -> FusionMaker:
    def make(config: FusionConfig, centres: Floats) -> _FunctionFusion:  # noqa: ARG001
        return _FunctionFusion(function)

    return make


@dataclass(frozen=True, slots=True)
class _FunctionFusion:
    function: Callable[[Vehicles, list[AgentPose]], Vehicles]

    def fuse(self, found: Vehicles, poses: list[AgentPose]) -> Vehicles:
        """See `Fusion.fuse`."""
        return self.function(found, poses)


def _policy_maker(function: Callable[[Observation, Signal], int | str]) -> PolicyMaker:
    def make(config: SignalConfig, site: SignalSite) -> _FunctionPolicy:  # noqa: ARG001
        return _FunctionPolicy(function, site.signal)

    return make


@dataclass(frozen=True, slots=True)
class _FunctionPolicy:
    function: Callable[[Observation, Signal], int | str]
    signal: Signal

    @property
    def needs_vehicles(self) -> bool:
        """Always true: the function gets the full observation."""
        return True

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        chosen = self.function(observation, self.signal)
        state = chosen if isinstance(chosen, str) else self._green(chosen)
        if isinstance(chosen, str):
            self._check(chosen)
        return Decision(state, [], _name("signal.policy", self.function))

    def _green(self, chosen: object) -> str:
        """Returns the green of an index."""
        greens, tls = self.signal.greens, self.signal.tls
        try:
            index = operator.index(cast("int", chosen))
        except TypeError:
            index = None
        if index is None or isinstance(chosen, bool):
            raise self._wrong(
                f"chose {_shown(chosen)} for {tls}, must choose an index from 0 to "
                f"{len(greens) - 1} or a state of links"
            )
        if not 0 <= index < len(greens):
            raise self._wrong(f"chose green {index} of {tls}, which has 0 to {len(greens) - 1}")
        return greens[index]

    def _check(self, state: str) -> None:
        """Checks a state for what the cabinet would refuse in every frame."""
        signal, links = self.signal, len(self.signal.plan[0].state)
        if len(state) != links or not set(state) <= set("Ggr") or not set(state) & set("Gg"):
            raise self._wrong(
                f"chose {state!r:.80} for {signal.tls}, must choose one of its greens "
                f"{', '.join(signal.greens)}, or a G, g or r for each of {links} links, not all r"
            )
        pairs = [f"{a} and {b}" for a, b in signal.conflicts if _clash(signal, state, a, b)]
        if pairs:
            more = f" and {len(pairs) - 4} more" if len(pairs) > 4 else ""
            raise self._wrong(
                f"chose {state!r} for {signal.tls}, which gives green to links that conflict: "
                f"{', '.join(pairs[:4])}{more}; its greens are {', '.join(signal.greens)}"
            )

    def _wrong(self, what: str) -> ConfigError:
        return _wrong("controller", self.function, what)


def _clash(signal: Signal, state: str, a: int, b: int) -> bool:
    """Whether two conflicting links may go in a state, and in no green with as much right."""
    if "r" in (state[a], state[b]):
        return False
    return not any(
        {green[a], green[b]} <= set("Gg")
        and state[a] in (green[a], "g")
        and state[b] in (green[b], "g")
        for green in signal.planned_greens
    )


def _numbers(found: object) -> Floats | None:
    try:
        return np.asarray(found, np.float64)
    except (TypeError, ValueError):
        return None


def _shown(found: object) -> str:
    """Returns a function's result as text, for errors."""
    if isinstance(found, np.ndarray):
        return f"{found.dtype} {found.shape}"
    return f"a {type(found).__name__} ({found!r:.40})"


def _wrong(what: str, function: object, text: str) -> ConfigError:
    name = f"{OWN}{getattr(function, '__name__', type(function).__name__)}"
    return ConfigError(f"the {what} {name} of this program {text}")
