"""Plug-ins: what other installed packages add, found by name through entry points.

A package declares its plug-ins in its metadata, in pyproject.toml for instance

    [project.entry-points."cpnet.detectors"]
    grid = "my_package.grid:make"

Names are listed without anything being imported; a plug-in is imported once it is asked for by its
name. A built-in name always means what is built in. A program that runs cpnet in its own process
may add plug-ins of its own for as long as a run lasts, see `provided`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, distributions, entry_points
from typing import Annotated, Any

from pydantic import Field, JsonValue

from protocol.errors import ConfigError, CpnetError

OWN = "own:"
"""Prefix of the names of plug-ins that a program provides: a run's record names them later."""

PluginSettings = Annotated[
    dict[str, JsonValue],
    Field(
        description="settings of a plug-in, as its own documentation has them; what is built in "
        "does not read them"
    ),
]


@dataclass(frozen=True, slots=True)
class Plugin:
    """A plug-in that was imported. `label` names its kind, itself and the package it came with."""

    label: str
    value: Any

    def make(self, method: str, *arguments: object) -> Any:  # noqa: ANN401 - a foreign object
        """Calls what the entry point names; what comes back has the method.

        Raises:
            ConfigError: it takes no such arguments, refuses its settings, or lacks the method.
        """
        if not callable(self.value):
            raise self.wrong(f"is {_kind(self.value)}, must be callable")
        try:
            made = self.value(*arguments)
        except CpnetError:
            raise
        except (ValueError, TypeError, LookupError) as error:
            raise self.wrong(f"cannot be made: {type(error).__name__}: {error}") from error
        if not callable(getattr(made, method, None)):
            raise self.wrong(f"makes {_kind(made)}, which has no method `{method}`")
        return made

    def wrong(self, what: str) -> ConfigError:
        """Returns the error with what is wrong with it."""
        return ConfigError(f"{self.label} {what}")


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The names of one kind: those built in, and those of the entry points of a group."""

    group: str
    noun: str
    builtin: tuple[str, ...]

    def has(self, name: str) -> bool:
        """Whether a plug-in of this name is built in or installed."""
        is_known = name in self.builtin or name.startswith(OWN)
        return is_known or bool(self._installed(name))

    def checked(self, name: str) -> str:
        """Returns the name if there is a plug-in of this name.

        Raises:
            ValueError: there is none; the text lists those that are.
        """
        if not self.has(name):
            raise ValueError(f"must be one of {self.listed()}")
        return name

    def listed(self) -> str:
        """Lists all names for people, installed ones with their packages."""
        points = sorted(_points(self.group), key=lambda point: point.name)
        installed = [f"{point.name} ({_package(point)})" for point in points]
        found = ", ".join(installed) if installed else "none"
        return f"{', '.join(self.builtin)}; installed plug-ins ({self.group}): {found}"

    def load(self, name: str) -> Plugin:
        """Imports an installed plug-in.

        Raises:
            ConfigError: there is none or more than one, or it cannot be imported.
        """
        if (self.group, name) in _provided:
            return Plugin(f"the {self.noun} {name} of this program", _provided[self.group, name])
        if name.startswith(OWN):
            raise ConfigError(
                f"{self.noun} {name!r} was a part of the program that ran this: run that program"
            )
        points = self._installed(name)
        if not points:
            raise ConfigError(f"{self.noun} {name!r}: must be one of {self.listed()}")
        if len(points) > 1:
            packages = ", ".join(sorted(map(_package, points)))
            raise ConfigError(f"{self.noun} {name!r} is in more than one package: {packages}")
        plugin = f"the {self.noun} {name} of {_package(points[0])}"
        try:
            return Plugin(plugin, points[0].load())
        except Exception as error:  # a foreign module may raise anything
            raise ConfigError(
                f"{plugin} cannot be imported ({points[0].value}): {type(error).__name__}: {error}"
            ) from error

    def _installed(self, name: str) -> list[EntryPoint]:
        return [point for point in _points(self.group) if point.name == name]


_provided: dict[tuple[str, str], Any] = {}


@contextmanager
def provided(plugins: Mapping[tuple[str, str], Any]) -> Iterator[None]:
    """Adds plug-ins, by group and name, to those of installed packages, in this process alone.

    Raises:
        ConfigError: one of them is there already: another run has not ended.
    """
    for group, name in plugins:
        if (group, name) in _provided:
            raise ConfigError(
                f"{group}: {name} is in use by a run that has not ended; end or close it first"
            )
    _provided.update(plugins)
    try:
        yield
    finally:
        for key in plugins:
            del _provided[key]


def packages() -> dict[str, str]:
    """Returns the versions, by name, of the installed packages that bring plug-ins."""
    return {
        package.name: package.version
        for package in distributions()
        if any(point.group.startswith("cpnet.") for point in package.entry_points)
    }


def _points(group: str) -> tuple[EntryPoint, ...]:
    return _points_on(group, tuple(sys.path))


@cache
def _points_on(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:  # noqa: ARG001 - what is found depends on it
    return tuple(entry_points(group=group))


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown package"


def _kind(value: object) -> str:
    return f"a {type(value).__name__}"
