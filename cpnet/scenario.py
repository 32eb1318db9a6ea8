"""The scenario: every number of a run, each with a default; YAML, a built-in name or neither."""

from __future__ import annotations

import copy
import difflib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import AfterValidator, BaseModel, Field, PositiveInt, ValidationError

from edge_server.config import EdgeConfig
from protocol.config import Section, is_file
from protocol.errors import ConfigError
from protocol.instances import REGION_ID
from protocol.plugins import PluginSettings
from recording.config import RecordConfig, ReplayConfig
from sensing.config import (
    LIDAR_SOURCES,
    LidarConfig,
    Mount,
    PoseErrorConfig,
    SceneConfig,
    UploadConfig,
)
from sensing.link_config import LinkConfig
from signal_controller.config import SignalConfig
from sim_host.config import CabinetConfig, TrafficConfig

_NOT_YAML = (yaml.YAMLError, ValueError, RecursionError)  # the loader lets all of them out

# Renamed keys: of earlier versions -> present ones. Dotted; an old key may name a whole section.
# `changed` and `validate` refuse the old key and name the new one.
RENAMED_KEYS: dict[str, str] = {
    "record.tape": "record.mcap",
    "replay.tape": "replay.recording",
    "signal.reckon_inflow_vph": "signal.estimator_inflow_vph",
    "signal.reckon_s": "signal.estimator_timeout_s",
    "signal.reckon_saturation_vph": "signal.estimator_saturation_vph",
    "traffic.reach_m": "traffic.radius_m",
    "edge.plausibility": "edge.misbehaviour",
    "edge.sight_m": "edge.coverage_range_m",
    "edge.standing_mps": "edge.stationary_mps",
    "carla": "lidar.plugin",
    "traffic.tls": "junctions",
    "region": "regions",
}


Regions = dict[Annotated[str, Field(pattern=rf"^{REGION_ID}$", max_length=64)], list[str]]


Realism = Literal["paper", "clear", "hard"]
"""Realism presets: how difficult the simulated world is, see `cpnet/realism`."""


class LidarPair(Section):
    """The two kinds of LiDAR, and what simulates their scans."""

    source: Annotated[str, AfterValidator(LIDAR_SOURCES.checked)] = Field(
        "cast",
        description="cast: by our model, in the scene drawn for the net; or the name of a plug-in, "
        "such as carla of examples/carla_package",
    )
    plugin: PluginSettings = Field({})
    vehicle: LidarConfig = Field(LidarConfig(), description="on every CAV")
    roadside: LidarConfig = Field(LidarConfig(), description="on every roadside mount")


class ProcessConfig(Section):
    """Distribution of work over processes."""

    vehicle: int = Field(
        2, ge=1, le=64, description="vehicle processes; CAVs are spread over those that run"
    )


class Scenario(Section):
    """A whole run. Its sections belong to the roles that read them."""

    name: str = Field(
        "t_junction",
        pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$",
        max_length=80,
        description="what the run is called in reports and its folder by default",
    )
    seed: int = Field(
        1, ge=0, lt=2**31, description="traffic, CAVs, scene and noise follow from it"
    )
    mode: Literal["lockstep", "realtime"] = Field(
        "lockstep",
        description="lockstep: the world waits for each frame's request, the same results on any "
        "machine; realtime: the world runs on the wall clock, late frames are used as they are",
    )
    duration_s: float = Field(60.0, gt=0, le=86_400, description="simulated time after warm-up")
    frame_period_s: float = Field(
        0.1, gt=0, le=60, description="one perception frame; a multiple of traffic.step_s"
    )
    junctions: Literal["all"] | list[str] | None = Field(
        None, description="ids of the signals to control; null: the only one of the net"
    )
    regions: PositiveInt | Regions = Field(
        1,
        description="parts of the city, an edge server each: a number, into so many compact and "
        "balanced parts the junctions are cut; or the junctions of each, by the region's id",
    )
    asked: dict[str, Any] | None = Field(
        None,
        description="junctions, regions and roadside_mounts as they were asked for; `cpnet up` "
        "fills it in, for there they stand as they were resolved",
    )
    realism: Realism = Field(
        "paper",
        description="what sensors, vehicles and maps are like, where the keys below say nothing "
        "else. paper: as in Chen et al. 2022, cars alone; clear: mixed traffic and real sensors in "
        "good weather; hard: with weather, and errors of poses, clocks and maps",
    )
    recording: str | None = Field(
        None,
        description="folder whose traffic and scans are played in the place of SUMO and the LiDAR "
        "model; a frame of it a step: needs traffic.step_s as frame_period_s, traffic.warmup_s 0",
    )
    replay: ReplayConfig | None = Field(
        None, description="the recording that is played; `cpnet replay` fills it in"
    )
    traffic: TrafficConfig = TrafficConfig()
    cabinet: CabinetConfig = CabinetConfig()
    lidar: LidarPair = LidarPair()
    sensor_height_m: float = Field(
        2.4, gt=0, le=10, description="of a CAV's LiDAR, above the centre of its footprint"
    )
    roadside_mounts: list[Mount] = Field(
        [Mount()], description="roadside units with a LiDAR; may be empty"
    )
    scene: SceneConfig = SceneConfig()
    pose: PoseErrorConfig = PoseErrorConfig()
    upload: UploadConfig = UploadConfig()
    link: LinkConfig = LinkConfig()
    edge: EdgeConfig = EdgeConfig()
    signal: SignalConfig = SignalConfig()
    record: RecordConfig = RecordConfig()
    processes: ProcessConfig = ProcessConfig()


def builtin_names() -> list[str]:
    """Returns the names of the scenarios that come with the package."""
    folder = resources.files("cpnet").joinpath("scenarios")
    return sorted(
        f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml")
    )


def load(name_or_file: str, overrides: dict[str, Any]) -> Scenario:
    """Reads a built-in or a YAML file and lays the overrides (dotted keys) over it.

    Raises:
        ConfigError: no such scenario, unreadable YAML, an unknown key or a value out of range.
    """
    source, data = _read(name_or_file)
    return changed(data, overrides, source)


def changed(data: dict[str, Any], overrides: dict[str, Any], source: str) -> Scenario:
    """Lays overrides (dotted keys) over a scenario's data and checks it; `source` as in `validate`.

    Raises:
        ConfigError: an unknown key or a value out of range.
    """
    data = copy.deepcopy(data)
    for key, value in overrides.items():
        _put(data, key, value)
    return validate(data, source)


def validate(data: dict[str, Any], source: str) -> Scenario:
    """Checks a scenario's data; `source` names its origin in errors.

    Raises:
        ConfigError: a key that was renamed, an unknown key or a value out of range.
    """
    _check_renamed(data, source)
    try:
        scenario = Scenario.model_validate(_over_realism(data))
    except ValidationError as error:
        lines = [_explain(dict(item)) for item in error.errors()[:8]]
        raise ConfigError(f"{source}: " + "\n".join(lines)) from None
    _check_period(scenario, source)
    _check_mounts(scenario, source)
    _check_recording(scenario, source)
    _check_link(scenario, source)
    _check_advice(scenario, source)
    _check_weight(scenario, source)
    return scenario


def _over_realism(data: dict[str, Any]) -> dict[str, Any]:
    """Returns a scenario's data merged over its realism preset."""
    name = data.get("realism", Scenario.model_fields["realism"].default)
    if name not in get_args(Realism):
        return data  # which is refused
    preset: dict[str, Any] = {}
    for layer in ("clear", "hard") if name == "hard" else (name,):
        text = resources.files("cpnet").joinpath(f"realism/{layer}.yaml").read_text("utf-8")
        preset = _laid_over(preset, yaml.safe_load(text) or {})
    return _laid_over(preset, data)


def _laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merges two mappings recursively; where values conflict, the upper one wins."""
    both = dict(below)
    for key, value in above.items():
        under = both.get(key)
        if isinstance(under, dict) and isinstance(value, dict):
            both[key] = _laid_over(under, value)
        else:
            both[key] = value
    return both


def parse_assignment(text: str) -> tuple[str, Any]:
    """Reads `key=value` of `--set`; the value is YAML."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {text!r}: needs key=value, such as traffic.cav_rate=0.1")
    try:
        return key.strip(), yaml.safe_load(value)
    except _NOT_YAML as error:
        raise ConfigError(f"--set {key}: the value {value!r:.80} is not YAML: {error}") from None


def _check_renamed(data: dict[str, Any], source: str) -> None:
    found = [f"{old} is now {new}" for old, new in RENAMED_KEYS.items() if _holds(data, old)]
    if found:
        raise ConfigError(f"{source}: renamed key: " + "\n".join(found))


def _holds(data: object, dotted: str) -> bool:
    """Whether the data have that dotted key, in any entry where a list is on the way."""
    if isinstance(data, list):
        return any(_holds(entry, dotted) for entry in data)
    key, _, rest = dotted.partition(".")
    if not isinstance(data, dict) or key not in data:
        return False
    return not rest or _holds(data[key], rest)


def _read(name_or_file: str) -> tuple[str, dict[str, Any]]:
    if name_or_file in builtin_names():
        text = (
            resources.files("cpnet").joinpath(f"scenarios/{name_or_file}.yaml").read_text("utf-8")
        )
    else:
        path = Path(name_or_file)
        if not is_file(path):
            raise ConfigError(
                f"there is no scenario {name_or_file!r}: neither a file nor one of the built-in "
                f"{', '.join(builtin_names())}"
            )
        try:
            text = path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from None
    try:
        data = yaml.safe_load(text) or {}
    except _NOT_YAML as error:
        raise ConfigError(f"{name_or_file}: not YAML: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{name_or_file}: holds a {type(data).__name__}, needs keys and values")
    return name_or_file, data


def _put(data: dict[str, Any], dotted: str, value: object) -> None:
    *path, last = _split(dotted)
    here = data
    for key in path:
        if here.get(key) is None:
            here[key] = {}
        if not isinstance(here[key], dict):
            raise ConfigError(f"{dotted}: {key} is {here[key]!r:.80}, which has no keys of its own")
        here = here[key]
    here[last] = value


def _split(dotted: str) -> list[str]:
    """Splits a key, but leaves what follows a mapping's name whole: edge ids may hold dots."""
    parts = dotted.split(".")
    model: Any = Scenario
    for depth, part in enumerate(parts):
        field = model.model_fields.get(part) if _is_section(model) else None
        if field is None:
            return [*parts[:depth], ".".join(parts[depth:])] if not _is_section(model) else parts
        model = _section_of(field.annotation)
    return parts


def is_section(dotted: str) -> bool:
    """Whether a dotted key is that of a section, not of a value."""
    model: Any = Scenario
    for part in dotted.split("."):
        field = model.model_fields.get(part) if _is_section(model) else None
        if field is None:
            return False
        model = _section_of(field.annotation)
    return _is_section(model)


def _is_section(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _explain(item: dict[str, Any]) -> str:
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] != "extra_forbidden":
        return f"{where}: {item['msg'].removeprefix('Value error, ')} (got {item['input']!r:.80})"
    *path, key = item["loc"]
    allowed = _keys_at(path)
    close = difflib.get_close_matches(str(key), allowed, n=1)
    hint = f"; did you mean {close[0]}?" if close else ";"
    section = f"section {'.'.join(map(str, path))}" if path else "a scenario"
    return f"unknown key {where}{hint} {section} allows: {', '.join(allowed)}"


def _keys_at(path: list[int | str]) -> list[str]:
    model: Any = Scenario
    for part in path:
        if isinstance(part, int):
            model = model.__args__[0]
        elif part in model.model_fields:  # else it is the tag of a union
            model = _section_of(model.model_fields[part].annotation)
    return list(model.model_fields)


def _check_mounts(scenario: Scenario, source: str) -> None:
    names = [mount.id for mount in scenario.roadside_mounts]
    if len(set(names)) < len(names):
        raise ConfigError(f"{source}: roadside_mounts have the ids {names}, each may stand once")


def _check_recording(scenario: Scenario, source: str) -> None:
    traffic = scenario.traffic
    if scenario.recording is None:
        return
    if scenario.cabinet.control == "actuated":
        raise ConfigError(
            f"{source}: a recording has no loop detectors: cabinet.control is actuated, must be "
            "requests"
        )
    if traffic.step_s != scenario.frame_period_s or traffic.warmup_s != 0:
        raise ConfigError(
            f"{source}: a recording is played a frame a step, without warm-up: traffic.step_s is "
            f"{traffic.step_s:g}, must be frame_period_s, {scenario.frame_period_s:g}; "
            f"traffic.warmup_s is {traffic.warmup_s:g}, must be 0"
        )


def _section_of(annotation: Any) -> Any:  # noqa: ANN401 - typing has no name for what annotations are
    """Returns the section of `Section | None`, the first of several, anything else as it is."""
    choices = [choice for choice in getattr(annotation, "__args__", ()) if _is_section(choice)]
    return choices[0] if choices and not hasattr(annotation, "__origin__") else annotation


def _check_link(scenario: Scenario, source: str) -> None:
    link, fits = scenario.link, {"lockstep": "virtual", "realtime": "emulated"}
    if link.apply not in ("auto", "none", fits[scenario.mode]):
        raise ConfigError(
            f"{source}: link.apply is {link.apply}, but in mode {scenario.mode} links can only be "
            f"{fits[scenario.mode]}; write auto, or change the mode"
        )


def _check_advice(scenario: Scenario, source: str) -> None:
    if scenario.signal.speed_advice and scenario.cabinet.control == "actuated":
        raise ConfigError(
            f"{source}: signal.speed_advice tells of greens that are requested: cabinet.control is "
            "actuated, which ignores requests, must be requests"
        )


def _check_weight(scenario: Scenario, source: str) -> None:
    signal = scenario.signal
    is_queued = signal.policy == "max_pressure" and signal.weight == "queued"
    if is_queued and not scenario.edge.tracking.enabled:
        raise ConfigError(
            f"{source}: signal.weight is queued: who stands still is known by tracks alone, and "
            "edge.tracking.enabled is false, must be true"
        )


def _check_period(scenario: Scenario, source: str) -> None:
    ratio = scenario.frame_period_s / scenario.traffic.step_s
    if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
        raise ConfigError(
            f"{source}: frame_period_s is {scenario.frame_period_s} s, "
            f"it must be a multiple of traffic.step_s, {scenario.traffic.step_s} s"
        )
