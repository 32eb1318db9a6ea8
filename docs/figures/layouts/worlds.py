"""Harder worlds: realism by part, unseen networks, poses and alignment, LiDARs."""

from __future__ import annotations

import re
from collections.abc import Callable
from statistics import mean
from typing import Any

from layouts.tables import Rows, Table, between, fixed, interval


def realism(data: dict[str, Rows]) -> Table:
    """Returns a line for each part of realism; what it costs is paired by seed with the first."""
    rows = data["runs"]
    detectors = list(dict.fromkeys(row["detector"] for row in rows))
    first, *_ = parts = list(dict.fromkeys(row["part"] for row in rows))
    heads = ["E-CVPR, %", "lost, points", "of the visible, %", "false boxes a frame"]
    table = [["part", *(f"`{name}`: {head}" for name in detectors for head in heads)]]
    by = {(row["part"], row["detector"], row["seed"]): row for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    for part in parts:
        cells = []
        for name in detectors:
            own = [by[part, name, seed] for seed in seeds]
            plain = [by[first, name, seed] for seed in seeds]
            lost = [100 * (a["e_cvpr"] - b["e_cvpr"]) for a, b in zip(plain, own, strict=True)]
            cells += [
                fixed(mean(row["e_cvpr"] for row in own), 1, 100),
                "" if part == first else interval(lost, 1),
                interval([100 * row["e_cvpr"] / row["visible_share"] for row in own], 1),
                interval([row["false_detections"] for row in own], 2),
            ]
        table.append([part, *cells])
    return table


def unseen(rows: Rows) -> Table:
    """Returns a line for each detector: means over networks, with 95 % intervals."""
    table = [["detector", "networks", "E-CVPR, %", "of the visible, %", "false boxes a frame"]]
    for name in dict.fromkeys(row["detector"] for row in rows):
        own = [row for row in rows if row["detector"] == name]
        cells = [
            interval([100 * row["e_cvpr"] for row in own], 1),
            interval([100 * row["e_cvpr"] / row["visible_share"] for row in own], 1),
            interval([row["false_detections"] for row in own], 2),
        ]
        table.append([f"`{name}`", str(len(own)), *cells])
    return table


def tracks(rows: Rows) -> Table:
    """Returns a column for each world: means over networks, with 95 % intervals."""
    found: dict[str, Rows] = {}
    for row in rows:
        found.setdefault(re.split("world=| network=", row["title"])[1], []).append(row)
    table = [["", *found]]
    for name, scale, digits, value in _OF_TRACKS:
        values = [
            [scale * one for row in own if (one := value(row)) is not None]
            for own in found.values()
        ]
        table.append([name, *(between(one, digits) if one else "–" for one in values)])
    return table


_OF_TRACKS: tuple[tuple[str, float, int, Callable[[dict[str, Any]], float | None]], ...] = (
    ("IDF1, %", 100, 1, lambda row: row["idf1"]),
    ("HOTA by centres, %", 100, 1, lambda row: row["hota"]),
    ("HOTA by IoU from above, %", 100, 1, lambda row: row["hota_iou"]),
    ("id switches per 100 vehicles", 100, 1, lambda row: row["id_switches"] / row["passages"]),
    ("speed RMSE, observed, m/s", 1, 2, lambda row: row["speed_rmse_mps"]["observed"]),
    ("speed RMSE, coasted, m/s", 1, 2, lambda row: row["speed_rmse_mps"]["coasted"]),
    ("precision of observed boxes, %", 100, 1, lambda row: row["precision"]["observed"]),
    ("precision of coasted boxes, %", 100, 1, lambda row: row["precision"]["coasted"]),
    ("precision of all boxes, %", 100, 1, lambda row: row["precision"]["all"]),
    ("E-CVPR of observed boxes, %", 100, 1, lambda row: row["ecvpr"]["observed"]),
    ("E-CVPR of all boxes, %", 100, 1, lambda row: row["ecvpr"]["all"]),
    ("its bound: vehicles visible so far, %", 100, 1, lambda row: row["ecvpr"]["visible_so_far"]),
    (
        "its bound: in a LiDAR's range so far, %",
        100,
        1,
        lambda row: row["ecvpr"]["in_range_so_far"],
    ),
    ("hidden up to 5 s, back under the same id, %", 100, 1, lambda row: row["hidden"]["recovered"]),
    ("coasted for 3 s, within 2 m, %", 100, 1, lambda row: row["coasted_3s"]["within_2m"]),
)


def counts(rows: Rows) -> Table:
    """Returns a line for each share of CAVs; differences are paired by network."""
    heads = ["E-CVPR without tracks, %", "with tracks, %", "in range of a LiDAR, %"]
    errors = ["error of a lane's count, vehicles, without", "with", "less, %"]
    table = [["CAVs, %", *heads, *errors]]
    by = {(r["traffic.cav_rate"], r["network"], r["edge.tracking.enabled"]): r for r in rows}
    shares, networks = ({key[n] for key in by} for n in range(2))
    for share in sorted(shares):
        without, tracked = (
            [by[share, network, on] for network in sorted(networks)] for on in ("false", "true")
        )
        pairs = list(zip(without, tracked, strict=True))
        table.append(
            [
                f"{100 * share:g}",
                *(interval([100 * row["e_cvpr"] for row in own], 1) for own in (without, tracked)),
                interval([100 * row["in_range_share"] for row in tracked], 1),
                *(interval([row["count_error"] for row in own], 3) for own in (without, tracked)),
                interval([100 * (1 - b["count_error"] / a["count_error"]) for a, b in pairs], 1),
            ]
        )
    return table


_WORLDS = {
    "paper": "as in Chen et al. (`paper`)",
    "all: hard": "all kinds of traffic, rain (`hard`)",
}


def realism_accuracy(data: dict[str, Rows]) -> Table:
    """Returns AP40 of cars and of trucks for each part of realism."""
    rows = data["accuracy"]
    by = {(row["part"], row["detector"], row["objects"]): row["ap40"] for row in rows}
    kinds = [(name, one) for name in dict.fromkeys(r["detector"] for r in rows) for one in _KINDS]
    table = [["part", *(f"`{name}`: {_KINDS[one]}" for name, one in kinds)]]
    for part in dict.fromkeys(row["part"] for row in rows):
        found = [by[part, *kind] for kind in kinds]
        table.append([part, *("–" if one is None else fixed(one, 1, 100) for one in found)])
    return table


_KINDS = {"vehicle": "all vehicles", "car": "cars, vans", "truck": "lorries, buses"}


def realism_readme(data: dict[str, Rows]) -> Table:
    """Returns a line for the easiest and the hardest world."""
    rows = data["runs"]
    heads = ["E-CVPR", "of what is visible", "false boxes a frame"]
    detectors = list(dict.fromkeys(row["detector"] for row in rows))
    table = [["world", *(f"`{name}`: {head}" for name in detectors for head in heads)]]
    for part, words in _WORLDS.items():
        cells = []
        for name in detectors:
            own = [row for row in rows if (row["part"], row["detector"]) == (part, name)]
            cells += [
                f"{fixed(mean(row['e_cvpr'] for row in own), 1, 100)} %",
                f"{fixed(mean(row['e_cvpr'] / row['visible_share'] for row in own), 1, 100)} %",
                fixed(mean(row["false_detections"] for row in own), 1),
            ]
        table.append([words, *cells])
    return table


def alignment(rows: Rows) -> Table:
    """Returns a line for each case of poses: means over seeds, differences paired by seed."""
    first, *_ = names = list(dict.fromkeys(row["poses"] for row in rows))
    table = [["poses", "E-CVPR, %", "points lost", "false boxes a frame"]]
    for name in names:
        own = {row["seed"]: row for row in rows if row["poses"] == name}
        base = {row["seed"]: row for row in rows if row["poses"] == first}
        lost = [100 * (base[seed]["e_cvpr"] - own[seed]["e_cvpr"]) for seed in own]
        table.append(
            [
                name,
                interval([100 * row["e_cvpr"] for row in own.values()], 1),
                "" if name == first else interval(lost, 1),
                interval([row["false_detections"] for row in own.values()], 2),
            ]
        )
    return table


def lidar_cells(lidar: dict[str, float]) -> list[str]:
    """Returns rings, points a second and range as cells of a table."""
    return [
        f"{lidar['channels']:g}",
        f"{lidar['points_per_second']:,}",
        f"{lidar['range']:g}",
    ]


LIDAR_HEADS = ["rings", "points/s", "range, m"]


def lidars(kinds: dict[str, dict[str, float]]) -> str:
    """Returns a sentence on the LiDARs behind each E-CVPR."""
    words: dict[tuple[str, ...], list[str]] = {}
    for kind, one in kinds.items():
        words.setdefault(tuple(lidar_cells(one)), []).append(f"`{kind}`")
    parts = [
        f"{', '.join(names)}: {rings} rings, {points} points a second, range {range_m} m"
        for (rings, points, range_m), names in words.items()
    ]
    return f"LiDARs behind each E-CVPR, on posts and CAVs alike, by `realism`: {'; '.join(parts)}."
