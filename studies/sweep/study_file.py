"""A study file: which scenario keys are varied, over which values and seeds.

From top to bottom: names that an axis may not have, axes and their combinations, the file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from perception.config import DetectorName
from protocol.config import Section, is_file
from protocol.errors import ConfigError

MEASURES = frozenset(
    {
        "frames",
        "e_cvpr",
        "e_cvpr_std",
        "e_cvpr_hist",
        "visible_share",
        "in_range_share",
        "present",
        "false_detections",
        "count_error",
        "count_bias",
        "delay_s",
        "delay_std_s",
        "delay_p95_s",
        "stops",
        "co2_g",
        "switches",
        "vehicles_at_start",
        "vehicles_inserted",
        "vehicles_finished",
        "vehicles_teleported",
        "vehicles_waiting",
        "uplink_mbps",
        "uplink_peak_mbps",
        "wire_up_mbps",
        "wire_down_mbps",
    }
)
"""Keys of the whole run's figures by `studies.sweep.worker.measure`."""

LISTS = frozenset({"e_cvpr_hist"})
PART_MEASURES = frozenset({"mbps", "agents", "handovers"})
"""Further measures, of the tables by junction and by region."""
RESERVED = frozenset({"grid", "seed", "n", "tls", "region"}) | MEASURES | PART_MEASURES
"""Names that no axis may have; nor a measure's name with a suffix, such as delay_s_mean."""


def is_taken(name: str) -> bool:
    """Whether a column of this name is the table's own."""
    stems = (name.removeprefix("_").rpartition("_")[0], name)
    return name in RESERVED or any(stem in MEASURES | PART_MEASURES for stem in stems)


Label = str | int | float
Settings = dict[str, Any]
"""Values by dotted scenario keys."""


def _shape(axis: object) -> object:
    if isinstance(axis, list) and axis:
        return axis
    if isinstance(axis, dict) and axis and all(isinstance(v, dict) for v in axis.values()):
        return axis
    raise ValueError("must be a list of values, or labels with the keys that each sets")


Axis = Annotated[list[Any] | dict[Any, Settings], BeforeValidator(_shape)]


@dataclass(frozen=True, slots=True)
class Choice:
    """One value of an axis."""

    label: Label
    settings: Settings


@dataclass(frozen=True, slots=True)
class Point:
    """One combination of a grid's axes."""

    labels: dict[str, Label]
    settings: Settings


def points(axes: dict[str, Axis]) -> Iterator[Point]:
    """Yields the full product; the last axis changes first."""
    named = [[(name, choice) for choice in _choices(name, axis)] for name, axis in axes.items()]
    for combination in product(*named):
        settings: Settings = {}
        for _, choice in combination:
            settings |= choice.settings
        yield Point({name: choice.label for name, choice in combination}, settings)


def check_axes(axes: dict[str, Axis]) -> None:
    """Checks names, labels and keys of axes.

    Raises:
        ValueError: a name is taken, a label is a duplicate or no text, two axes set one key.
    """
    setter: dict[str, str] = {}
    for name, axis in axes.items():
        if is_taken(name):
            raise ValueError(f"an axis is called {name}: this is a column of its own in the table")
        choices = _choices(name, axis)
        _check_labels(name, [choice.label for choice in choices])
        for key in {key for choice in choices for key in choice.settings}:
            if key == "seed":
                raise ValueError(f"the axis {name} sets seed: give seeds: [..] instead")
            other = next(
                (own for own in setter if setter[own] != name and keys_overlap(key, own)), None
            )
            if other is not None:
                raise ValueError(f"the axes {setter[other]} and {name} both set {key}")
            setter[key] = name


def keys_overlap(key: str, other: str) -> bool:
    """Whether two dotted keys name the same value, or one a part of the other."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


def check_settings(settings: Settings, axes: dict[str, Axis]) -> None:
    """Checks that no axis varies a key that is to be set.

    Raises:
        ConfigError: one does.
    """
    for name, axis in axes.items():
        for choice in _choices(name, axis):
            both = sorted(
                key for key in settings for own in choice.settings if keys_overlap(key, own)
            )
            if both:
                raise ConfigError(f"--set {both[0]}: the axis {name} varies it")


def _choices(name: str, axis: Axis) -> list[Choice]:
    if isinstance(axis, dict):
        return [Choice(label, dict(settings)) for label, settings in axis.items()]
    return [Choice(_label(value), {name: value}) for value in axis]


def _label(value: object) -> Label:
    """Returns a value as it is written into the table: numbers and texts unchanged."""
    is_plain = isinstance(value, (str, int, float)) and not isinstance(value, bool)
    return value if is_plain else json.dumps(value, default=str)  # type: ignore[return-value]


def _check_labels(name: str, labels: list[Label]) -> None:
    for label in labels:
        if isinstance(label, bool) or not isinstance(label, (str, int, float)):
            raise ValueError(f"the axis {name} has the label {label!r}: put it into quotes")
    for label in labels:
        if isinstance(label, int) and abs(label) >= 1 << 63:
            raise ValueError(f"the axis {name} has the label {label}: put it into quotes")
    shown = [str(label) for label in labels] if str in map(type, labels) else labels
    if len(set(shown)) < len(shown):  # as the table writes them
        raise ValueError(f"the axis {name} has the values {labels}, each may stand once")


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=80)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]

_NOT_YAML = (yaml.YAMLError, ValueError, RecursionError)


class Grid(Section):
    """A full product of axes."""

    name: Name = Field(description="value of the table's column `grid`")
    settings: Settings = Field({}, alias="set", description="of its cells: dotted scenario keys")
    axes: dict[str, Axis] = Field(
        {}, description="a scenario key and its values, or a name and what each label sets"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_axes(self.axes)
        return self


_PAGES: dict[str, dict[str, tuple[str, ...]]] = {
    "paper": {
        "perception": ("edge.detector", "traffic.cav_rate"),
        "reports": ("traffic.cv_rate",),
        "control": ("controller",),
    },
    "bandwidth": {
        "every-second": ("upload", "uplink in Mbit/s"),
        "whole-scans": ("deadline in ms", "uplink in Mbit/s"),
        "foreground": ("deadline in ms", "uplink in Mbit/s"),
        "each-its-part": ("deadline in ms", "uplink in Mbit/s"),
        "boxes": ("deadline in ms", "uplink in Mbit/s"),
        "latency": ("latency in ms",),
        "loss": ("packets lost, %",),
    },
}
"""By page, the grids that it needs, with their axes."""


class Accuracy(Section):
    """Accuracy of detectors scan by scan, on samples of the study's junction."""

    detectors: list[DetectorName] = Field(min_length=1, description="side by side")
    samples: int = Field(40, ge=1, le=500, description="some seconds apart")


class Study(Section):
    """A whole study."""

    name: Name = Field(description="names the folder of the results")
    title: str | None = Field(None, description="a line for people")
    scenario: str = Field("t_junction", description="built-in name, or a file beside this one")
    settings: Settings = Field({}, alias="set", description="of all cells: dotted scenario keys")
    seeds: list[Seed] = Field([1], min_length=1, description="each cell is run with each")
    grids: list[Grid] = Field(min_length=1, description="or `axes` here, for a single one")
    accuracy: Accuracy | None = Field(
        None, description="AP40 on the junction of `scenario` and `set`, for the page `paper`"
    )
    page: Literal["plain", "paper", "bandwidth", "value"] = Field(
        "plain",
        description="plain: a section for each grid; paper: as Chen et al. 2022 has them; "
        "bandwidth: what an uplink must carry; value: from where on delay suffers, and two "
        "controllers in pairs",
    )

    @model_validator(mode="before")
    @classmethod
    def _single_grid(cls, data: Any) -> Any:  # noqa: ANN401 - whatever the file held
        if not isinstance(data, dict) or "axes" not in data:
            return data
        if "grids" in data:
            raise ValueError("give axes or grids, not both")
        others = {key: value for key, value in data.items() if key != "axes"}
        return others | {"grids": [{"name": "all", "axes": data["axes"]}]}

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [grid.name for grid in self.grids]
        if len(set(names)) < len(names):
            raise ValueError(f"grids have the names {names}, each may stand once")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds are {self.seeds}, each may stand once")
        if "seed" in self.settings:
            raise ValueError("set names seed: give seeds: [..] instead")
        _check_page(self.page, self.grids)
        return self

    def changed(self, settings: dict[str, Any], seeds: list[int]) -> Study:
        """Returns the study with other settings, which win over the file's, and other seeds.

        Raises:
            ConfigError: an axis varies a key that is to be set, or a seed is out of range.
        """
        for grid in self.grids:
            check_settings(settings, grid.axes)
        data = self.model_dump(by_alias=True)
        data["set"] = _without_overridden(self.settings, settings) | settings
        data["seeds"] = seeds or self.seeds
        for grid in data["grids"]:
            for own in _partial_overrides(grid["set"], settings):
                raise ConfigError(f"--set {own}: grid {grid['name']} sets a whole that holds it")
            grid["set"] = _without_overridden(grid["set"], settings)
        return _validated(data, f"study {self.name}")


def _without_overridden(settings: Settings, stronger: Settings) -> Settings:
    """Returns settings without those that higher-priority ones replace completely."""
    return {
        key: value
        for key, value in settings.items()
        if not any(f"{key}.".startswith(f"{one}.") for one in stronger)
    }


def _partial_overrides(settings: Settings, stronger: Settings) -> list[str]:
    """Returns the higher-priority keys that name a part of a setting with a mapping as value."""
    return [one for one in stronger for key in settings if one.startswith(f"{key}.")]


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study, and where it was read."""

    study: Study
    source: str
    folder: Path

    @property
    def scenario(self) -> str:
        """The built-in scenario's name, or the path of its file."""
        beside = self.folder / self.study.scenario
        return str(beside) if is_file(beside) else self.study.scenario


def builtin_studies() -> list[str]:
    """Returns the names of the studies that come with the package."""
    folder = resources.files("studies").joinpath("builtin")
    return sorted(
        f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml")
    )


def path_of(what: str) -> Path:
    """Returns the file of a built-in study, or the path that was given."""
    if what in builtin_studies():
        return Path(str(resources.files("studies"))) / f"builtin/{what}.yaml"
    return Path(what)


def read_study(what: str) -> StudyFile:
    """Reads a built-in study or a file.

    Raises:
        ConfigError: there is no such study, or it is invalid.
    """
    path = path_of(what)
    if not is_file(path):
        known = ", ".join(builtin_studies())
        raise ConfigError(
            f"there is no study {what!r}: neither a file nor one of the built-in {known}"
        )
    try:
        data = yaml.load(path.read_text("utf-8"), _Strict)
    except OSError as error:
        raise ConfigError(f"{what}: cannot be read: {error}") from None
    except _NOT_YAML as error:
        raise ConfigError(f"{what}: not YAML: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{what}: holds a {type(data).__name__}, needs keys and values")
    return StudyFile(_validated(data, what), what, path.parent)


def study_of(data: Mapping[str, Any]) -> StudyFile:
    """Returns a study from what a file would hold.

    Raises:
        ConfigError: it is invalid.
    """
    return StudyFile(_validated(dict(data), "the study"), "the study", Path())


def _validated(data: dict[str, Any], source: str) -> Study:
    try:
        return Study.model_validate(data)
    except ValidationError as error:
        lines = [_explain(dict(item)) for item in error.errors()[:8]]
        raise ConfigError(f"{source}: " + "\n".join(lines)) from None


_RENAMED_KEYS = {"accuracy.moments": "accuracy.samples"}


def _explain(item: dict[str, Any]) -> str:
    *path, key = item["loc"] or ("",)
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] != "extra_forbidden":
        text = item["msg"].removeprefix("Value error, ")
        return f"{where}: {text} (got {item['input']!r:.80})" if where else text
    if where in _RENAMED_KEYS:
        return f"{where} is called {_RENAMED_KEYS[where]} now"
    model = Accuracy if path == ["accuracy"] else Grid if path else Study
    allowed = [field.alias or name for name, field in model.model_fields.items()]
    allowed += [] if path else ["axes"]
    kind = {Accuracy: "accuracy", Grid: "a grid", Study: "a study"}[model]
    return f"unknown key {key} in {where}; {kind} allows: {', '.join(allowed)}"


def _check_page(page: str, grids: list[Grid]) -> None:
    axes = {grid.name: tuple(grid.axes) for grid in grids}
    for name, needed in _PAGES.get(page, {}).items():
        if axes.get(name) != needed:
            raise ValueError(
                f"page: {page} needs a grid {name} with the axes {', '.join(needed)}; "
                "page: plain takes any grids"
            )


_MERGE = "tag:yaml.org,2002:merge"


class _Strict(yaml.SafeLoader):
    """Refuses duplicate keys: of two equal labels, one would vanish."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """See `yaml.SafeLoader`; what is merged in (<<) may be overridden, as YAML has it."""
        own = [key for key, _ in node.value if key.tag != _MERGE]
        keys = [self.construct_object(key, deep=True) for key in own]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", node.start_mark
                )
        return super().construct_mapping(node, deep)
