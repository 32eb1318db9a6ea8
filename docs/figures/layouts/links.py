"""Uplinks: ways to upload, highest rates, links that lose packets."""

from __future__ import annotations

from collections.abc import Callable
from statistics import mean

from layouts.tables import Rows, Table, fixed


def uplink(link: str) -> Callable[[Rows], Table]:
    """Returns the layout of upload policies on one link."""

    def layout(rows: Rows) -> Table:
        heads = ["kB", "Mbit/s", "mean", "p95", "scans/s", "seen %", "false a frame", "count"]
        return [[LINKS[link], *heads]] + [
            [
                f"`{row['policy']}`", fixed(row["bytes_per_frame"], 1, 1e-3),
                fixed(row["mbps_per_agent"], 2), fixed(row["latency_ms"]["mean"], 1),
                fixed(row["latency_ms"]["p95"], 1), fixed(row["fps"], 1),
                fixed(row["recall_visible"], 1, 100), fixed(row["false_per_frame"], 1),
                fixed(row["count_error"], 2),
            ]
            for row in rows if row["link"] == link
        ]  # fmt: skip

    return layout


LINKS = {
    "5mbit": "5 Mbit/s",
    "lte": "LTE, 6 Mbit/s on average, round trip 50 ms",
    "5g-urban": "urban 5G, 50 Mbit/s on average, round trip 16 ms",
}
_WAYS_TO_UPLOAD = {
    "full": "whole scans to the edge",
    "reap+foreground": "`reap` with `foreground` (EMP's scheme, without ground and background)",
    "objects": "boxes, detected on the agents",
    "sharing": "no edge: everybody hears everybody and detects alone",
}


def uplink_readme(rows: Rows) -> Table:
    """Returns the README's table of ways to upload."""
    by_policy = {row["policy"]: row for row in rows if row["link"] == "5mbit"}
    table = [["", "bytes a frame", "mean latency", "visible vehicles detected"]]
    for policy, words in _WAYS_TO_UPLOAD.items():
        row = by_policy[policy]
        size = f"{fixed(row['bytes_per_frame'], 1, 1e-3)} kB"
        latency = f"{fixed(row['latency_ms']['mean'], 0)} ms"
        table.append([words, size, latency, f"{fixed(row['recall_visible'], 1, 100)} %"])
    return table


def uplink_emp(rows: Rows) -> Table:
    """Returns the latency of EMP's scheme on mobile networks, beside the published one."""
    by_link = {row["link"]: row for row in rows if row["policy"] == "reap+foreground"}
    table = [["sensing to signal", "mean, ms", "p95, ms"]]
    for link in ("lte", "5g-urban"):
        ms = by_link[link]["latency_ms"]
        words = f"`reap+foreground` on {LINKS[link]}"
        table.append([words, fixed(ms["mean"], 0), fixed(ms["p95"], 0)])
    return [*table, ["EMP, as published, over a cellular network, without detection", "93", "–"]]


def rates(rows: Rows) -> Table:
    """Returns the highest frame rate of each policy."""
    table = [["policy", "at 10 frames/s, mean / p95", "highest rate kept up with"]]
    for policy in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == policy]
        ms = own[0]["latency_ms"]
        best_hz = max((row["rate_hz"] for row in own if row["is_sustained"]), default=0)
        latency = f"{fixed(ms['mean'], 0)} / {fixed(ms['p95'], 0)} ms"
        table.append([f"`{policy}`", latency, f"{best_hz:g} frames/s"])
    return table


def emulated(runs: Rows) -> Table:
    """Returns link latency by kind of link."""
    table = [["", "p50", "p95"]]
    for name, run in zip(("virtual", "emulated"), runs, strict=True):
        link = run["latency_ms"]["link"]
        table.append([name, fixed(link["p50"], 1), fixed(link["p95"], 1)])
    return table


def lossy(rows: Rows) -> Table:
    """Returns delays over lossy paths: of the kernel's TCP, and the ratios of both of ours."""
    terms = {"mean_ms": "mean", "restricted_ms": "mean to 1 s", "p95_ms": "p95"}
    heads = [
        f"{form} / kernel, {name}" for form in ("virtual", "emulated") for name in terms.values()
    ]
    of_kernel = f"kernel, {' / '.join(terms.values())}, ms"
    table = [["link", "message", "every", "minutes", of_kernel, *heads]]
    for row in rows:
        size, period = f"{row['size_bytes'] / 1e3:g} kB", f"{row['period_s']:g} s"
        minutes = f"{row['messages'] * row['seeds'] * row['period_s'] / 60:g}"
        kernel = " / ".join(fixed(row["kernel"][term], 1) for term in terms)
        ratios = [
            "{:.2f} ({:.2f} to {:.2f})".format(*row["of_kernel"][form][term])
            for form in ("virtual", "emulated")
            for term in terms
        ]
        table.append([f"`{row['link']}`", size, period, minutes, kernel, *ratios])
    return table


_UPLOADS = {
    "whole-scans": "whole scans",
    "foreground": "without ground and background",
    "each-its-part": "each agent its part of that (EMP)",
    "boxes": "boxes, detected on the agents",
}
_RATE, _DEADLINE = "uplink in Mbit/s", "deadline in ms"
_ENOUGH = 0.99  # of the E-CVPR on the fastest link, as docs/bandwidth.md has it


def bandwidth_readme(rows: Rows) -> Table:
    """Returns the slowest uplink that is enough, by upload, frame period and deadline."""
    ten = [row for row in rows if row["grid"] in _UPLOADS]
    deadlines = sorted({row[_DEADLINE] for row in ten})
    heads = [f"ten times a second, within {deadline:g} ms" for deadline in deadlines]
    table = [["Mbit/s an agent", "once a second", *heads]]
    for grid, words in _UPLOADS.items():
        every_second = [
            row for row in rows if row["grid"] == "every-second" and words.startswith(row["upload"])
        ]
        groups = [[r for r in ten if (r["grid"], r[_DEADLINE]) == (grid, d)] for d in deadlines]
        table.append([words, *map(_enough, [every_second, *groups])])
    return table


def _enough(rows: Rows) -> str:
    """Returns the slowest rate with enough of the E-CVPR on the fastest, means over seeds."""
    seen: dict[float, list[float]] = {}
    for row in rows:
        seen.setdefault(row[_RATE], []).append(row["e_cvpr"])
    if not seen:
        return "–"
    goal = _ENOUGH * mean(seen[max(seen)])
    return f"{min(rate for rate, found in seen.items() if mean(found) >= goal):g}"
