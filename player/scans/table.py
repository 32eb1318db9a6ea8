"""CSV tables with named columns, as poses and extrinsics come in."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.scans.numbers import lines_of, numbers_of
from protocol.errors import ConfigError
from protocol.geometry import Floats

PLACE = ("x_m", "y_m", "z_m")
TURN = ("roll_deg", "pitch_deg", "yaw_deg")
"""May be left out: 0."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One line: a pose (6,) in m and rad, the other columns as text, and where it stands."""

    where: str
    pose: Floats
    others: dict[str, str]


def rows_of(path: Path, others: Sequence[str]) -> Iterator[Row]:
    """Yields the rows of a table of poses; of `others`, the columns that are there.

    Raises:
        ConfigError: the file cannot be read, lacks a column, or a line of it is wrong.
    """
    lines = lines_of(path)
    reader = csv.DictReader(lines, skipinitialspace=True)
    try:
        names = [name.strip() for name in reader.fieldnames or []]
        reader.fieldnames = names
        _check_names(names, [*PLACE, *TURN, *others], path)
        for line in reader:
            where = f"{path}: line {reader.line_num}"
            if None in line:  # where the reader puts what has no column
                raise ConfigError(f"{where}: has more fields than the {len(names)} columns")
            yield Row(
                where,
                _pose(line, where),
                {n: (line[n] or "").strip() for n in others if n in names},
            )
    except csv.Error as error:  # it has not counted the line that it failed on
        raise ConfigError(f"{path}: line {reader.line_num + 1}: {error}") from None


def _check_names(names: Sequence[str], allowed: Sequence[str], path: Path) -> None:
    if missing := [name for name in PLACE if name not in names]:
        raise ConfigError(f"{path}: line 1: lacks the column {missing[0]}")
    if odd := [name for name in names if name not in allowed]:
        raise ConfigError(
            f"{path}: line 1: unknown column {odd[0]!r:.40}; allowed: {', '.join(allowed)}"
        )
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{path}: line 1: has the column {twice[0]} twice")


def _pose(line: dict[str, str | None], where: str) -> Floats:
    turn = [line.get(name, "0") for name in TURN]
    numbers = numbers_of([*(line[name] for name in PLACE), *turn], where)
    return np.array([*numbers[:3], *np.radians(numbers[3:])])
