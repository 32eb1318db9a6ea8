"""Axes of a study: a scenario key with values, or a name of one's own with labelled settings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any

from pydantic import BeforeValidator

from protocol.errors import ConfigError
from studies.columns import is_taken

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
    """Checks what pydantic cannot.

    Raises:
        ValueError: a name is taken, a label stands twice or is none, two axes set one key.
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
            other = next((own for own in setter if setter[own] != name and touch(key, own)), None)
            if other is not None:
                raise ValueError(f"the axes {setter[other]} and {name} both set {key}")
            setter[key] = name


def touch(key: str, other: str) -> bool:
    """Whether two dotted keys name the same value, or one a part of the other."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


def settings_clash(settings: Settings, axes: dict[str, Axis]) -> None:
    """Checks that no axis varies what is to be set.

    Raises:
        ConfigError: one does.
    """
    for name, axis in axes.items():
        for choice in _choices(name, axis):
            both = sorted(key for key in settings for own in choice.settings if touch(key, own))
            if both:
                raise ConfigError(f"--set {both[0]}: the axis {name} varies it")


def _choices(name: str, axis: Axis) -> list[Choice]:
    if isinstance(axis, dict):
        return [Choice(label, dict(settings)) for label, settings in axis.items()]
    return [Choice(_label(value), {name: value}) for value in axis]


def _label(value: object) -> Label:
    """Returns a value as it stands in the table: numbers and texts as they are."""
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
