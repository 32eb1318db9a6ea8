"""The regions of a scenario: its junctions cut into compact, balanced parts, or as they are given.

The cut is METIS's (Karypis and Kumar 1998), on the graph of intersections that a lane joins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from protocol.approaches import Approaches
from protocol.errors import ConfigError, did_you_mean
from protocol.extras import to_install
from protocol.roadmap import RoadMap

_SEED = 1


def resolve_regions(
    road_map: RoadMap, wanted: int | Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Returns the signals of each region, sorted.

    Raises:
        ConfigError: a region has no junction, a junction is in two regions, in none or unknown.
    """
    known = sorted(road_map.by_tls)
    if not isinstance(wanted, int):
        return _checked(wanted, known)
    if wanted > len(known):
        raise ConfigError(
            f"regions is {wanted}, but there are {len(known)} junctions: {wanted - len(known)} "
            "regions would have none"
        )
    parts = [0] * len(known) if wanted == 1 else _cut(road_map, known, wanted)
    groups: dict[int, list[str]] = {}
    for tls, part in zip(known, parts, strict=True):
        groups.setdefault(part, []).append(tls)
    return {f"r{number}": group for number, group in enumerate(groups.values())}


def _checked(wanted: Mapping[str, Sequence[str]], known: list[str]) -> dict[str, list[str]]:
    times = Counter(tls for junctions in wanted.values() for tls in junctions)
    for region, junctions in wanted.items():
        if not junctions:
            raise ConfigError(f"regions.{region} has no junction; each region needs one at least")
        for tls in junctions:
            if tls not in known:
                raise ConfigError(
                    f"regions.{region}: {tls!r} is none of the controlled junctions"
                    f"{did_you_mean(tls, known)}; they are: {', '.join(known[:20])}"
                )
    if twice := [tls for tls in known if times[tls] > 1]:
        where = [region for region, junctions in wanted.items() if twice[0] in junctions]
        raise ConfigError(f"regions: {twice[0]!r} stands in {' and '.join(where)}, must be in one")
    if lost := [tls for tls in known if not times[tls]]:
        raise ConfigError(f"regions: {', '.join(lost[:5])} in no region; each junction needs one")
    return {region: sorted(junctions) for region, junctions in wanted.items()}


def _cut(road_map: RoadMap, known: list[str], regions: int) -> list[int]:
    try:
        import pymetis
    except ImportError:
        raise ConfigError(f"regions: pymetis is missing: {to_install('sim')}") from None
    number = {tls: index for index, tls in enumerate(known)}
    joined: list[set[int]] = [set() for _ in known]
    for one in road_map.intersections:
        for lane in Approaches(road_map, one).downstream:
            owner = number[road_map.by_id[lane].tls]
            if owner != number[one.tls]:
                joined[number[one.tls]].add(owner)
                joined[owner].add(number[one.tls])
    _join_nearest(road_map, known, joined)
    options: Any = pymetis.Options(seed=_SEED)
    _, parts = pymetis.part_graph(
        regions, adjacency=[sorted(one) for one in joined], options=options
    )
    return _without_gaps([int(part) for part in parts], regions)


def _join_nearest(road_map: RoadMap, known: list[str], joined: list[set[int]]) -> None:
    """Connects separate parts of the graph to their nearest: METIS needs it in one piece."""
    places = np.array([road_map.by_tls[tls].centre[:2] for tls in known])
    apart_m = np.linalg.norm(places[:, None] - places, axis=2)
    while len(here := _piece(joined)) < len(known):
        inside = np.isin(np.arange(len(known)), sorted(here))
        gaps_m = np.where(inside[:, None] & ~inside, apart_m, np.inf)
        a, b = (int(n) for n in np.unravel_index(int(gaps_m.argmin()), gaps_m.shape))
        joined[a].add(b)
        joined[b].add(a)


def _piece(joined: list[set[int]]) -> set[int]:
    found, todo = {0}, [0]
    while todo:
        for other in joined[todo.pop()] - found:
            found.add(other)
            todo.append(other)
    return found


def _without_gaps(parts: list[int], regions: int) -> list[int]:
    """Gives a part that was left empty, which METIS may do to small graphs, one of the largest."""
    for empty in set(range(regions)) - set(parts):
        most = max(set(parts), key=lambda part: (parts.count(part), -part))
        parts[len(parts) - 1 - parts[::-1].index(most)] = empty
    return parts
