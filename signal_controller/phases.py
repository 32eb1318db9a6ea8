"""Phases beside those of a plan: signal groups that do not conflict, shown green together.

A plan shows its movements in few combinations. Signal groups (in North America: the phases of a
dual ring and overlaps, Signal Timing Manual, 2nd edition, chapter 5) may be combined in any way in
which no two conflict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from itertools import islice

from protocol.roadmap import RoadMap, Signal

MAX_PHASES = 16
"""With those of the plan: the time that a decision takes grows with them."""
_MAX_SETS = 4096  # that are looked at: signals of several junctions may have very many
Group = frozenset[int]
"""Links that turn green together, by their index."""


def with_compatible_phases(signal: Signal, road_map: RoadMap) -> Signal:
    """Returns the signal with the greens that its signal groups allow beside those of its plan.

    A signal group is made of the links of a movement, from edge to edge, and of all movements that
    share a lane with it: no lane gets green for a part of its turns. Each maximal set of groups of
    which no two conflict is a phase, unless the plan has one with right of way for all its links.

    Of more than `MAX_PHASES` those that open most links are kept. Nothing is added where the plan
    shows green to others than vehicles: the conflicts of people who walk are not known. A group
    that the plan never opens as a whole, or in which links conflict, is in no added phase.

    Args:
        signal: with the phases of its plan.
        road_map: has the edges of its lanes.
    """
    signal = signal.model_copy(update={"further_greens": []})
    shown, protected = (
        [{link for link, c in enumerate(green) if c in right} for green in signal.greens]
        for right in ("Gg", "G")
    )
    if any(opened - {link.index for link in signal.links} for opened in shown):
        return signal
    foes = _foes(signal)
    groups = [
        group
        for group in _groups(signal, road_map)
        if any(group <= opened for opened in shown) and not any(foes[a] & group for a in group)
    ]
    compatible = {
        group: {other for other in groups if not any(foes[link] & other for link in group)}
        for group in groups
    }
    found = []
    for chosen in islice(_maximal(groups, compatible), _MAX_SETS):
        opened = frozenset().union(*chosen)
        if opened and not any(opened <= others for others in protected):
            size = len(signal.plan[0].state)
            found.append("".join("G" if link in opened else "r" for link in range(size)))
    found.sort(key=lambda green: -green.count("G"))
    room = max(0, MAX_PHASES - len(signal.greens))
    return signal.model_copy(update={"further_greens": found[:room]})


def _groups(signal: Signal, road_map: RoadMap) -> list[Group]:
    """Returns the signal groups, in the order of their first links."""
    groups: list[tuple[set[object], set[int]]] = []  # what makes links one group, and the links
    for link in signal.links:
        edges = road_map.edge_of(link.from_lane), road_map.edge_of(link.to_lane)
        keys: set[object] = {link.from_lane, edges}
        same = [group for group in groups if group[0] & keys]
        groups = [group for group in groups if group not in same]
        links = {link.index}.union(*(others for _, others in same))
        groups.append((keys.union(*(others for others, _ in same)), links))
    return sorted((Group(links) for _, links in groups), key=min)


def _foes(signal: Signal) -> dict[int, set[int]]:
    foes: dict[int, set[int]] = {link.index: set() for link in signal.links}
    for a, b in signal.conflicts:
        foes.setdefault(a, set()).add(b)
        foes.setdefault(b, set()).add(a)
    return foes


def _maximal(
    groups: Sequence[Group],
    compatible: Mapping[Group, Set[Group]],
    chosen: tuple[Group, ...] = (),
    tried: Sequence[Group] = (),
) -> Iterator[tuple[Group, ...]]:
    """Yields the maximal sets of groups of which all are compatible (Bron and Kerbosch 1973)."""
    if not groups and not tried:
        yield chosen
    for index, group in enumerate(groups):
        left = [other for other in groups[index + 1 :] if other in compatible[group]]
        before = [other for other in (*tried, *groups[:index]) if other in compatible[group]]
        yield from _maximal(left, compatible, (*chosen, group), before)
