"""Beside Chen et al. and other control: E-CVPR step by step, delay."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from layouts.tables import Rows, Table, between, fixed
from layouts.worlds import LIDAR_HEADS, lidar_cells
from studies.control_study import paired
from studies.value_page import LESS_IS_MORE, SUFFERS_SHARE


def ecvpr_steps(rows: Rows) -> Table:
    """Returns E-CVPR step by step from ours to theirs, each paired by seed with the one before."""
    own = [row for row in rows if row["grid"] == "steps"]
    table = [["each with what stands above it", *LIDAR_HEADS, "E-CVPR, %", "this step, points",
              "of the visible, %"]]  # fmt: skip
    before: dict[int, float] = {}
    for step in dict.fromkeys(row["step"] for row in own):
        part = [row for row in own if row["step"] == step]
        now = {row["seed"]: 100 * row["e_cvpr"] for row in part}
        change = [now[seed] - before[seed] for seed in now] if before else []
        table.append(
            [
                step,
                *lidar_cells(part[0]["lidar"]),
                between([*now.values()], 1),
                between(change, 1) if change else "",
                between([100 * row["e_cvpr"] / row["visible_share"] for row in part], 1),
            ]
        )
        before = now
    return table


_THEIRS = {0: (29.9, 31.4), 0.01: (35.4, 35.7), 0.02: (38.3, 37.4), 0.05: (None, 46.6)}
_AS_THEIRS = {
    "`reference`, their DBSCAN and size filter": "as theirs: `reference`, duplicates by radius",
    "CARLA's 56,000 points a second": "the same, range of 80 m, CARLA's default points a second",
}


def ecvpr_shares(rows: Rows) -> Table:
    """Returns E-CVPR by share of CAVs: ours, with their detector and fusion, and as published."""
    shown = {}
    for row in rows:
        share = 0.05 if row["grid"] == "steps" else row["traffic.cav_rate"]
        shown.setdefault(row["step"], {}).setdefault(share, []).append(row)
    heads = [f"{100 * share:g} % CAVs" for share in _THEIRS]
    table = [["E-CVPR, %", *LIDAR_HEADS, *heads]]
    for step, by_share in shown.items():
        if set(by_share) == set(_THEIRS):
            cells = [
                between([100 * row["e_cvpr"] for row in by_share[share]], 1) for share in _THEIRS
            ]
            table.append(
                [_AS_THEIRS.get(step, step), *lidar_cells(by_share[0][0]["lidar"]), *cells]
            )
    for place, name in enumerate(("DBSCAN", "PointPillars")):
        cells = [fixed(theirs[place], 1) for theirs in _THEIRS.values()]
        table.append([f"Chen et al., {name}", "64", "not stated", "not stated", *cells])
    return table


def paper_readme(rows: Rows) -> Table:
    """Returns E-CVPR and delay of Chen et al.'s experiments, means of seeds, beside theirs."""

    def cells(grid: str, key: str, measure: str, **where: str) -> dict[str | float, float]:
        own = [row for row in rows if row["grid"] == grid]
        own = [row for row in own if all(row[name] == value for name, value in where.items())]
        return {
            value: mean(row[measure] for row in own if row[key] == value)
            for value in dict.fromkeys(row[key] for row in own)
        }

    def perception(detector: str, measure: str) -> list[float]:
        where = {"edge.detector": detector}
        return [*cells("perception", "traffic.cav_rate", measure, **where).values()]

    def listed(values: Sequence[float], factor: float, unit: str) -> str:
        return ", ".join(fixed(value, 1, factor) for value in values) + f" {unit}"

    shares = ", ".join(f"{100 * share:g}" for share in _THEIRS)
    by_detector = zip(*_THEIRS.values(), strict=True)
    theirs = [", ".join(fixed(one, 1) for one in column) for column in by_detector]
    fast, pillars = "fast", "pointpillars"
    delays_s = perception(fast, "delay_s") + perception(pillars, "delay_s")
    empty_s = cells("unseen-empty", "traffic.cav_rate", "delay_s")[0]
    control_s = cells("control", "controller", "delay_s")
    reported_s = cells("reports", "traffic.cv_rate", "delay_s")
    known = (0.02, 0.05, 0.1, 0.3)
    others_s = [control_s[name] for name in _PAPER_CONTROLS]
    return [
        ["", "cpnet", "Chen et al."],
        [f"E-CVPR at {shares} % CAVs, clustering",
         listed(perception(fast, "e_cvpr"), 100, "%"), f"{theirs[0]} %"],
        ["the same, PointPillars",
         listed(perception(pillars, "e_cvpr"), 100, "%"), f"{theirs[1]} %"],
        ["what the LiDARs saw of all vehicles, at most",
         listed(perception(fast, "visible_share"), 100, "%"), "–"],
        ["mean delay, max pressure on these, a lane's unseen part as full as the rest (ours)",
         f"{fixed(min(delays_s), 1)} to {fixed(max(delays_s), 1)} s", "–"],
        ["… at 0 % CAVs, the unseen part empty, as in Chen et al.",
         f"{fixed(empty_s, 1)} s", "10.6 to 11.0 s"],
        ["… on perfect counts, the same on 50 m and none behind, SUMO's actuated control, the "
         "net's fixed plan, Webster's", listed(others_s, 1, "s"), "–"],
        [f"… on {', '.join(f'{100 * share:g}' for share in known)} % of vehicles that report "
         "themselves", listed([reported_s[share] for share in known], 1, "s"), "–"],
    ]  # fmt: skip


_PAPER_CONTROLS = (
    *("max pressure, perfect counts", "max pressure, perfect counts, tuned"),
    *("actuated by loops", "fixed plan", "fixed plan by Webster"),
)


_CONTROLS = {
    "perception": "max pressure on perception (a post, no CAV), 200 m before and 100 m behind",
    "perception, unseen empty": "the same, what no LiDAR sees taken for empty, as in Chen et al.",
    "perception, 50 m": "max pressure on perception, 50 m before and nothing behind",
    "perception, held": "max pressure on perception, tuned: 50 m before, greens of 10 s at least",
    "perception, predictive": "predictive control on perception",
    "perfect counts": "max pressure on perfect counts, 200 m before and 100 m behind",
    "perfect counts, 50 m": "max pressure on perfect counts, 50 m before and nothing behind",
    "perfect counts, held": "max pressure on perfect counts, tuned: 50 m, greens of 10 s at least",
    "perfect, predictive": "predictive control that knows every vehicle",
    "max wave": "max wave on perfect counts: 200 m before and nothing behind",
    "actuated": "SUMO's actuated control, loops, at its defaults",
    "actuated, tuned": "SUMO's actuated control, tuned: gaps of 2 s, greens of 25 s at most",
    "webster": "fixed plan by Webster's formula for this demand",
    "webster, tuned": "fixed plan for this demand, tuned: 0.85 of Webster's cycle",
    "own plan": "the net's own fixed plan",
}
_SHORT = (
    *("perception, predictive", "perfect, predictive", "actuated, tuned", "webster, tuned"),
    *("perception, 50 m", "perception"),
)


_BASES = {
    "perception": "more than the first line, s",
    "perception, predictive": "more than predictive control on perception, s",
    "perfect counts": "more than perfect counts, s",
}


def delay(rows: Rows) -> Table:
    """Returns delay by control, and how much more it is than some have, paired by seed."""
    return _delay(rows, tuple(_CONTROLS), tuple(_BASES))


def delay_short(rows: Rows) -> Table:
    """Returns what `delay` has of predictive control on perception and its alternatives."""
    return _delay(rows, _SHORT, _SHORT[:1])


def _delay(rows: Rows, names: Sequence[str], bases: Sequence[str]) -> Table:
    by: dict[str, dict[int, float]] = {}
    for row in rows:
        by.setdefault(row["control"], {})[row["seed"]] = row["delay_s"]
    runs = f"{len(by[bases[0]])} seeds of {rows[0]['frames']} s"
    table = [["control", f"delay, s; {runs}", *(_BASES[base] for base in bases)]]
    for name in names:
        cells = [
            "" if name == base else between([by[name][s] - by[base][s] for s in by[name]], 1)
            for base in bases
        ]
        table.append([_CONTROLS[name], between([*by[name].values()], 1), *cells])
    return table


def tuned(rows: Rows, lasts: str = "an hour") -> Table:
    """Returns the delay of each control as tuned, by traffic, and how far `predictive` lies off."""
    heads = [f"delay, s; {rows[0]['seeds']} seeds of {lasts}", "predictive control minus it, s"]
    table = [["traffic", "control", "tuning chosen on other seeds", *heads, "%", "longest wait, s"]]
    order = [*dict.fromkeys(_traffic(row) for row in rows)]
    for row in sorted(rows, key=lambda row: order.index(_traffic(row))):
        less = row["difference_s"]
        table.append(
            [
                _traffic(row),
                f"`{row['policy']}`",
                row["setting"] or "–",
                f"{row['delay_s']:.2f} ± {row['delay_ci95_s']:.2f}",
                "" if less is None else f"{less:.2f} ± {row['difference_ci95_s']:.2f}",
                "" if less is None else fixed(row["difference_share"], 0, 100),
                f"{row['waited_s']:.0f}",
            ]
        )
    return table


def tuned_networks(rows: Rows) -> Table:
    """Returns the same for nets with several signals."""
    return tuned(rows, "half an hour")


def loop(rows: Rows) -> Table:
    """Returns delay by traffic and control, and how far control on perception lies from it."""
    heads = ["arrived, %", "E-CVPR, %", "control on perception minus it, s", "%", "longest wait, s"]
    table = [["traffic", "control", f"delay, s; {rows[0]['seeds']} seeds of an hour", *heads]]
    order = [*dict.fromkeys(_traffic(row) for row in rows)]
    for row in sorted(rows, key=lambda row: order.index(_traffic(row))):
        less, seen = row["difference_s"], row.get("e_cvpr")
        words = f", {row['setting']}" if row["setting"] else ""
        name = row["policy"] if " " in row["policy"] else f"`{row['policy']}`"
        table.append(
            [
                _traffic(row),
                f"{name}{words}",
                f"{row['delay_s']:.2f} ± {row['delay_ci95_s']:.2f}",
                fixed(row["arrived"] / row["vehicles"], 1, 100),
                fixed(seen, 1, 100) if seen is not None else "",
                "" if less is None else f"{less:.2f} ± {row['difference_ci95_s']:.2f}",
                "" if less is None else fixed(row["difference_share"], 0, 100),
                f"{row['waited_s']:.0f}",
            ]
        )
    return table


def _traffic(row: Mapping[str, Any]) -> str:
    if row["net"] == "moving_peak":
        return "a peak that moves"
    return f"x{row['demand']:g}" if row["net"] == "t_junction" else str(row["net"])


_GIVEN = {
    "rate-whole-scans": ("uplink in Mbit/s", "uplink of an agent, Mbit/s: whole scans"),
    "rate-parts-as-EMP": ("uplink in Mbit/s", "the same: each agent its part (EMP)"),
    "rate-boxes": ("uplink in Mbit/s", "the same: boxes"),
    "latency": ("latency in ms", "round trip on 10 Mbit/s, ms"),
}


def value_readme(rows: Rows) -> Table:
    """Returns the least uplink and the longest latency at which predictive delay is as at best."""
    table = [["what is limited", "delay at best, s", "not worse to", "worse from, by s"]]
    for grid, (axis, words) in _GIVEN.items():
        curve: dict[float, dict[int, float]] = {}
        for row in rows:
            is_own = (row["grid"], row["controller"]) == (grid, "predictive")
            if is_own and row["delay_s"] is not None:
                curve.setdefault(row[axis], {})[row["seed"]] = row["delay_s"]
        table.append([words, *_knee(curve, is_more_better=not axis.startswith(LESS_IS_MORE))])
    return table


def _knee(curve: Mapping[float, Mapping[int, float]], *, is_more_better: bool) -> list[str]:
    """Returns delay at the best of a curve, the last point as good, the first that is worse."""
    best, *rest = sorted(curve, reverse=is_more_better)
    base, as_good = curve[best], best
    shown = f"{between([*base.values()], 1)}, at {best:g}"
    for given in rest:
        both = sorted(set(base) & set(curve[given]))
        found = paired([curve[given][s] for s in both], [base[s] for s in both])
        if found.mean > max(SUFFERS_SHARE * mean(base.values()), found.half or 0.0):
            more = [curve[given][s] - base[s] for s in both]
            return [shown, f"{as_good:g}", f"{given:g}: {between(more, 2)}"]
        as_good = given
    return [shown, f"{as_good:g}", "–"]


def of_lists(output: str) -> Rows:
    """Reads lists of rows in JSON, each after a form feed."""
    return [row for part in output.split("\f")[1:] for row in json.loads(part)]


def reports(rows: Rows) -> Table:
    """Returns delay by the share of vehicles that are known, beside all of them and a timer."""
    table = [["traffic", "vehicles known", "delay, s", "more than if all were known, s", "%",
              "more than with `webster`, s", "queue off by, vehicles",
              "in its 90 % interval, %", "longest wait, s"]]  # fmt: skip
    for traffic in dict.fromkeys(_traffic(row) for row in rows):
        by: dict[tuple[str, float], list[dict[str, Any]]] = {}
        for row in rows:
            if _traffic(row) == traffic:
                by.setdefault((row["policy"], row["reporting"]), []).append(row)
        whole, timer = _by_seed(by[_WHOLE]), _by_seed(by[_TIMER])
        for key, part in by.items():
            delays_s, is_whole, is_timer = _by_seed(part), key == _WHOLE, key == _TIMER
            errors = [row["queue_error"] for row in part if row["queue_error"] is not None]
            inside = [row["queue_inside"] for row in part if row["queue_inside"] is not None]
            more = [delays_s[seed] - whole[seed] for seed in delays_s]
            table.append(
                [
                    traffic,
                    "none: `webster`" if is_timer else f"{100 * key[1]:g} %",
                    between([*delays_s.values()], 1),
                    "" if is_whole else between(more, 1),
                    "" if is_whole else f"{100 * sum(more) / sum(whole.values()):.0f}",
                    "" if is_timer else between([delays_s[s] - timer[s] for s in delays_s], 1),
                    fixed(mean(errors) if errors else None, 2),
                    fixed(mean(inside) if inside else None, 0, 100),
                    f"{max(row['waited_s'] for row in part):.0f}",
                ]
            )
    return table


_WHOLE, _TIMER = ("predictive", 1), ("webster", 1)  # policy, share of vehicles known


def _by_seed(rows: Rows) -> dict[int, float]:
    return {row["seed"]: row["delay_s"] for row in rows}
