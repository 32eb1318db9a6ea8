"""Phases beside those of a plan: signal groups that do not conflict, shown green together.

A plan shows its movements in few combinations. Signal groups (in North America: the phases of a
dual ring and overlaps, Signal Timing Manual, 2nd edition, chapter 5) may be combined in any way in
which no two conflict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from itertools import islice
from typing import Any

from protocol.roadmap import RoadMap, Signal

MAX_PHASES = 16
"""With those of the plan: the time that a decision takes grows with them."""
_MAX_SETS = 4096  # that are looked at, and of which those that open most links are kept
Group = frozenset[int]
"""Links that turn green together, by their index."""


def with_phases(roads: RoadMap, section: Mapping[str, Any]) -> RoadMap:
    """Returns the map whose signals have the phases that a scenario's section `signal` asks for."""
    is_wanted = wants_compatible_phases(section)
    intersections = []
    for one in roads.intersections:
        further = compatible_phases(one.signal, roads) if is_wanted else []
        signal = one.signal.model_copy(update={"further_greens": further})
        intersections.append(one.model_copy(update={"signal": signal}))
    return RoadMap(name=roads.name, lanes=roads.lanes, intersections=intersections)


def wants_compatible_phases(section: Mapping[str, Any]) -> bool:
    """Whether a section `signal` asks for more phases than those of the plan."""
    phases = section.get("phases", "plan")
    return phases == "compatible" or (phases == "auto" and section.get("policy") == "predictive")


def compatible_phases(signal: Signal, roads: RoadMap) -> list[str]:
    """Returns the greens that a signal's groups allow beside those of its plan.

    A signal group is made of the links of a movement, from edge to edge, and of all movements that
    share a lane with it: no lane gets green for a part of its turns. Each maximal set of groups of
    which no two conflict is a phase, unless the plan has one with as much right of way for all its
    links. A group that the plan never opens as a whole, or in which links conflict, is in none.

    With the plan's there are at most `MAX_PHASES`: those that open most links. There are none where
    the plan shows green to others than road vehicles, as their conflicts are not known, and where
    one stop bar leads to another of the same signal: its plan coordinates them.

    Args:
        signal: with the phases of its plan.
        roads: which lanes are of one edge.
    """
    shown = [{link for link, c in enumerate(green) if c in "Gg"} for green in signal.planned_greens]
    room = MAX_PHASES - len(shown)
    others = any(opened - {link.index for link in signal.links} for opened in shown)
    if others or room <= 0 or _is_passed_twice(signal, roads):
        return []
    foes = _foes(signal)
    groups = [
        group
        for group in _groups(signal, roads)
        if any(group <= opened for opened in shown) and not any(foes[a] & group for a in group)
    ]
    compatible = {
        group: {o for o in groups if o != group and not any(foes[link] & o for link in group)}
        for group in groups
    }
    letters = {link: _letter(signal, link, foes) for link in foes}
    sets = islice(_maximal(set(groups), compatible), _MAX_SETS)
    size = len(signal.plan[0].state)
    found = dict.fromkeys(
        "".join(letters[link] if link in opened else "r" for link in range(size))
        for opened in sorted((sorted(Group().union(*one)) for one in sets), key=_most_links_first)
    )
    return [green for green in found if not _is_planned(signal, green)][:room]


def _most_links_first(opened: list[int]) -> tuple[int, list[int]]:
    return -len(opened), opened


def _is_planned(signal: Signal, green: str) -> bool:
    """Whether the plan opens all that a green does, with as much right of way; "G" < "g" < "r"."""
    return any(
        all(planned <= asked for planned, asked in zip(one, green, strict=True))
        for one in signal.planned_greens
    )


def _is_passed_twice(signal: Signal, roads: RoadMap) -> bool:
    before = {roads.edge_of(link.from_lane) for link in signal.links}
    return any(roads.edge_of(link.to_lane) in before for link in signal.links)


def _groups(signal: Signal, roads: RoadMap) -> list[Group]:
    """Returns the signal groups."""
    groups: list[tuple[set[object], set[int]]] = []  # what makes links one group, and the links
    for link in signal.links:
        edges = roads.edge_of(link.from_lane), roads.edge_of(link.to_lane)
        keys: set[object] = {link.index, link.from_lane, edges}
        same = [group for group in groups if group[0] & keys]
        groups = [group for group in groups if group not in same]
        links = {link.index}.union(*(others for _, others in same))
        groups.append((keys.union(*(others for others, _ in same)), links))
    return [Group(links) for _, links in groups]


def _foes(signal: Signal) -> dict[int, set[int]]:
    foes: dict[int, set[int]] = {link.index: set() for link in signal.links}
    for a, b in signal.conflicts:
        foes.setdefault(a, set()).add(b)
        foes.setdefault(b, set()).add(a)
    return foes


def _letter(signal: Signal, link: int, foes: Mapping[int, set[int]]) -> str:
    """Returns a link's letter where no foe is green: `g` if the plan has it yield to none of them.

    Then it yields to someone whom this signal does not stop.
    """
    shown = [green for green in signal.planned_greens if green[link] in "Gg"]
    to_others = any(
        green[link] == "g" and not any(green[foe] in "Gg" for foe in foes[link]) for green in shown
    )
    return "g" if to_others and not any(green[link] == "G" for green in shown) else "G"


def _maximal(
    groups: Set[Group],
    compatible: Mapping[Group, Set[Group]],
    chosen: tuple[Group, ...] = (),
    tried: Set[Group] = frozenset(),
) -> Iterator[tuple[Group, ...]]:
    """Yields the maximal sets of compatible groups (Bron and Kerbosch 1973, with a pivot)."""
    if not groups and not tried:
        if chosen:
            yield chosen
        return
    pivot = max(groups | tried, key=lambda one: (len(compatible[one] & groups), -min(one)))
    left, done = set(groups), set(tried)
    for group in sorted(groups - compatible[pivot], key=min):
        near = compatible[group]
        yield from _maximal(left & near, compatible, (*chosen, group), done & near)
        left.remove(group)
        done.add(group)
