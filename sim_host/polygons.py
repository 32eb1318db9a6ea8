"""Buildings from a user's SUMO polygon file."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from protocol.errors import ConfigError
from protocol.files import is_file

DEFAULT_HEIGHT_M = 10.0
MAX_HEIGHT_M = 1000.0
REACH_M = 400.0

Ring = list[tuple[float, float]]


def read_polygons(path: Path, centre: tuple[float, float, float]) -> tuple[list[Ring], list[float]]:
    """Returns outlines (map frame) and heights in m of the buildings around a centre.

    A building is a `<poly>` whose type holds "building"; if the file has none, every polygon with
    a `height` counts. Heights come from a `<param key="height">`, 10 m otherwise.

    Raises:
        ConfigError: the file is missing, is not XML, or has degrees instead of metres.
    """
    if not is_file(path):
        raise ConfigError(f"scene.polygons: file {path} does not exist")
    try:
        rows = list(ElementTree.parse(path).getroot().iter("poly"))
        found = [(_ring(row), _height(row), "building" in row.get("type", "")) for row in rows]
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise ConfigError(f"scene.polygons: {path} is no SUMO polygon file: {error}") from None
    if any(row.get("geo") in ("1", "true") for row in rows):
        raise ConfigError(f"scene.polygons: {path} is in degrees; convert it with polyconvert")
    named = any(building for _, _, building in found)
    kept = [
        (ring, height or DEFAULT_HEIGHT_M)
        for ring, height, building in found
        if (building if named else height > 0) and len(ring) >= 3 and _is_near(ring, centre)
    ]
    return [ring for ring, _ in kept], [height for _, height in kept]


def _ring(row: ElementTree.Element) -> Ring:
    ring = []
    for word in row.get("shape", "").split():
        x, y, *_ = (float(number) for number in word.split(","))
        ring.append((x, y))
    return ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring


def _height(row: ElementTree.Element) -> float:
    for param in row.iter("param"):
        if param.get("key") == "height":
            return _checked_height(float(param.get("value", "")))
    return 0.0


def _checked_height(height_m: float) -> float:
    if not 0 <= height_m <= MAX_HEIGHT_M:
        raise ValueError(f"a height is {height_m:g} m, allowed: 0 to {MAX_HEIGHT_M:g}")
    return height_m


def _is_near(ring: Ring, centre: tuple[float, float, float]) -> bool:
    away = np.array(ring) - np.array(centre[:2])
    return bool(np.isfinite(away).all() and np.linalg.norm(away, axis=1).min() <= REACH_M)
