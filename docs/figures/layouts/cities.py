"""Cities: delay by control, whole hours by junction, cost by size."""

from __future__ import annotations

from typing import Any

from layouts.tables import Rows, Table, fixed


def city_runs(runs: dict[str, dict[str, Any]]) -> Table:
    """Returns a line for each whole run of a net."""
    heads = ["junctions", "regions", "agents a frame", "real-time factor", "latency p50 / p95, ms"]
    table = [["net", *heads, "E-CVPR, %", "delay, s", "Mbit/s in all"]]
    for net, run in runs.items():
        ms = run["latency_ms"]["end_to_end"]
        table.append(
            [
                net, str(len(run["junctions"])), str(len(run["regions"])),
                fixed(sum(one["agents"] for one in run["regions"].values()), 1),
                fixed(run["real_time_factor"], 1),
                f"{fixed(ms['p50'], 0)} / {fixed(ms['p95'], 0)}",
                fixed(run["e_cvpr"]["mean"], 1, 100), fixed(run["delay_s"]["mean"], 1),
                fixed(sum(one["mbps"] for one in run["regions"].values()), 1),
            ]
        )  # fmt: skip
    return table


def city_junctions(runs: dict[str, dict[str, Any]]) -> Table:
    """Returns a line for each signal of those runs."""
    table = [["net", "signal", "delay, s", "E-CVPR, %", "switches", "count error"]]
    for net, run in runs.items():
        for tls, one in run["junctions"].items():
            table.append(
                [
                    net, f"`{tls}`", fixed(one["delay_s"], 1), fixed(one["e_cvpr"], 1, 100),
                    str(one["switches"]), fixed(one["count_error"], 2),
                ]
            )  # fmt: skip
    return table


_ROLES = ("vehicle", "infra", "edge", "sim", "record")


def scale(rows: Rows) -> Table:
    """Returns what a frame of an agent costs, a line for each size of a city."""
    heads = [
        "junctions",
        "regions",
        "agents",
        "CAVs",
        "real-time factor",
        "core-ms",
        "to the first",
    ]
    table = [[*heads, *(f"`{role}`" for role in _ROLES), "others", "MB a CAV"]]
    for row in rows:
        by = row["core_ms_by_role"]
        others = sum(value for role, value in by.items() if role not in _ROLES)
        table.append(
            [
                str(row["junctions"]), str(row["regions"]), fixed(row["agents"], 1),
                fixed(row["cavs"], 1), fixed(row["real_time_factor"], 2),
                fixed(row["core_ms"], 1), fixed(row["core_ms"] / rows[0]["core_ms"], 2),
                *(fixed(by[role], 2) for role in _ROLES), fixed(others, 2),
                fixed(row["agent_mb"], 1),
            ]
        )  # fmt: skip
    return table


def scale_parts(rows: Rows) -> Table:
    """Returns what casting, encoding and the edge's stages alone take at one junction."""
    row = rows[0]
    parts = row["parts_ms"]
    total = sum(parts.values())
    return [
        [*parts, "together", "of all processes", "ratio"],
        [
            *(fixed(value, 2) for value in [*parts.values(), total, row["core_ms"]]),
            fixed(row["core_ms"] / total, 2),
        ],
    ]
