"""Detectors: accuracy, time, and the agents that lie to them."""

from __future__ import annotations

from itertools import product
from typing import Any

from layouts.tables import Rows, Table, fixed

_CLOUDS = {"none": "one scan", "early": "merged", "late": "each scan, then fused"}
_CELLS = (("bev", 0.01), ("bev", 0.1), ("bev", 0.5), ("bev", 0.7), ("3d", 0.1), ("3d", 0.5))


def _visible(rows: Rows) -> dict[tuple[str, str, bool], dict[tuple[str, float], dict[str, Any]]]:
    """Returns rows of all visible vehicles by detector, cloud and geofence, then view and IoU."""
    found: dict[tuple[str, str, bool], dict[tuple[str, float], dict[str, Any]]] = {}
    for row in rows:
        is_vehicle = row.get("objects", "vehicle") == "vehicle"
        if is_vehicle and row["part"] == "all" and row["truth"] == "visible":
            key = row["detector"], _CLOUDS[row["fusion"]], row["geofence"]
            found.setdefault(key, {})[row["view"], row["iou"]] = row
    return found


def accuracy(rows: Rows) -> Table:
    """Returns average precision, recall and precision by detector."""
    heads = ["BEV 0.01", "0.1", "0.5", "0.7", "3D 0.1", "0.5", "recall", "precision"]
    table = [["detector", "cloud", "geofence", *heads]]
    order = {cloud: place for place, cloud in enumerate(_CLOUDS.values())}
    lines = _visible(rows)
    for key in sorted(lines, key=lambda k: (k[0], order[k[1]], not k[2])):
        detector, cloud, geofence = key
        cells = lines[key]
        at = cells["bev", 0.1]
        figures = [fixed(cells[cell]["ap40"], 1, 100) for cell in _CELLS]
        figures += [fixed(at["recall"], 1, 100), fixed(at["precision"], 1, 100)]
        table.append([f"`{detector}`", cloud, "yes" if geofence else "no", *figures])
    return table


def public_scans(rows: Rows) -> Table:
    """Returns what was found and what was right, by detector and scene, all Ouster's too."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    groups = {one: [one] for one in scenes}
    ouster = [one for one in scenes if not one.startswith("kitti")]
    groups |= {"streets": [one for one in ouster if one.startswith("street")]}
    groups |= {"all of Ouster's": ouster}
    ways = list(dict.fromkeys((row["detector"], row["score"]) for row in rows))
    heads = [f"`{name}`" + (f" from {score:g}" if score else "") for name, score in ways]
    table = [["scene", "vehicles", *(f"{head}, found / right" for head in heads)]]
    for group, members in groups.items():
        own = [row for row in rows if row["scene"] in members]
        count = sum(row["vehicles"] for row in own) // len(ways)
        table.append([group, str(count), *(_hits(own, way) for way in ways)])
    return table


def _hits(rows: Rows, way: tuple[str, float]) -> str:
    """Returns the shares of vehicles found and of boxes right, in per cent."""
    own = [row for row in rows if (row["detector"], row["score"]) == way]
    shares = (("found", "vehicles"), ("right", "boxes"))
    sums = [(sum(row[part] for row in own), sum(row[all_] for row in own)) for part, all_ in shares]
    return " / ".join(fixed(part / whole, 0, 100) if whole else "–" for part, whole in sums)


_OBJECTS = {
    "vehicle": "vehicles, whatever they are called",
    "car": "cars, vans",
    "truck": "lorries, buses",
    "two_wheeler": "two-wheelers",
    "pedestrian": "pedestrians",
}
_BY_CLASS: tuple[tuple[str, float], ...] = tuple(product(("visible", "all"), (0.1, 0.5, 0.7)))


def accuracy_by_class(rows: Rows) -> Table:
    """Returns average precision by class, of merged clouds inside the geofence, from above."""
    heads = [f"{truth}, {iou:g}" for truth, iou in _BY_CLASS]
    table = [["detector", "objects", "visible", *heads]]
    for detector in dict.fromkeys(row["detector"] for row in rows):
        for name, words in _OBJECTS.items():
            cells = {
                (row["truth"], row["iou"]): row
                for row in rows
                if (row["detector"], row["fusion"], row["view"]) == (detector, "early", "bev")
                and (row["part"], row["geofence"], row["objects"]) == ("all", True, name)
            }
            figures = [_with_half(cells[cell]) for cell in _BY_CLASS]
            count = str(cells["visible", 0.1]["vehicles"])
            table.append([f"`{detector}`", words, count, *figures])
    return table


def _with_half(row: dict[str, Any]) -> str:
    """Returns AP40 and half of its interval over networks, in per cent."""
    if row["ap40"] is None:
        return ""
    half = row["ap40_half"]
    found = fixed(row["ap40"], 1, 100)
    return found if half is None else f"{found} ± {fixed(half, 1, 100)}"


def _totals(rows: Rows) -> dict[tuple[str, int], dict[str, Any]]:
    return {(r["detector"], r["agents"]): r for r in rows if r["stage"] == "total"}


def edge(rows: Rows) -> Table:
    """Returns milliseconds of the edge by agents and detector."""
    totals = _totals(rows)
    detectors = list(dict.fromkeys(name for name, _ in totals))
    table = [["agents", "points", *(f"`{name}`" for name in detectors)]]
    for agents in dict.fromkeys(agents for _, agents in totals):
        own = [totals[name, agents] for name in detectors]
        table.append([str(agents), str(own[0]["points"]), *(fixed(r["ms_p50"], 1) for r in own)])
    return table


def misbehaviour(rows: Rows) -> Table:
    """Returns which attacks are detected, and after how long."""
    heads = [["what one agent sends"]]
    lines: dict[str, list[str]] = {}
    for rate in dict.fromkeys(row["cav_rate"] for row in rows):
        heads[0] += [f"{100 * rate:g} % CAVs: detected", "after, s"]
        for row in rows:
            if row["cav_rate"] == rate:
                after = "" if row["after_s"] is None else fixed(row["after_s"], 1)
                cells = [f"{row['found']} of {row['tried']}", after]
                lines.setdefault(row["attack"], []).extend(cells)
    return heads + [[attack, *cells] for attack, cells in lines.items()]
