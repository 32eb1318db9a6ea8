"""The answer of `cpnet compare`: its sentence, its table on a terminal, its page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from studies.approach_log import INTERVAL_S
from studies.bench import empty_table, print_whole
from studies.compare import (
    ACTUATED,
    ALL_KNOWN,
    BASELINES,
    MAX_PRESSURE,
    PLAN,
    PREDICTIVE,
    WEBSTER,
    Variant,
)
from studies.compare_question import BOTH, CAVS, POSTS, Comparison
from studies.control_study import paired
from studies.outlines import road_rings
from studies.page.model import (
    Block,
    Chart,
    Code,
    Column,
    Fact,
    MapChart,
    Page,
    Points,
    Section,
    Series,
    SideBySide,
    Table,
    Text,
    text_rows,
)

MIN_SEEDS = 5
"""From which on an interval is given; below, the least and the greatest of the seeds."""
_NAMES = {
    PLAN: "the net's own plan",
    WEBSTER: "Webster's fixed plan",
    ACTUATED: "actuated by loops",
    MAX_PRESSURE: "max pressure",
    PREDICTIVE: "predictive",
}
_MAX_APPROACHES = 12  # that are drawn; more are in a table
_HEADS = (
    *("control", "it sees", "what its tuning set", "arrived", "delay by seed, s", "delay, s"),
    *("95th percentile, s", "over own plan, s", "over best baseline, s"),
)
_SEEN_HEADS = ("control", "it sees", "E-CVPR, %", "false boxes a frame", "uplink, Mbit/s", "peak")


def name_of(one: Variant) -> str:
    """Returns what a variant is called in charts."""
    return f"{_NAMES[one.policy]}: {one.sight}" if one.sight else _NAMES[one.policy]


def best_baseline(variants: Sequence[Variant]) -> Variant:
    """Returns the tuned timer or loop control of least delay on the reported seeds."""
    found = [one for one in variants if one.policy in BASELINES and one.policy != PLAN]
    return min(found, key=lambda one: one.delay_s)


def answer(comparison: Comparison, variants: Sequence[Variant]) -> str:
    """Returns what a city wants to know: how much delay, how many posts, what uplink.

    It is about the predictive policy, which is chosen beforehand, not about the best of all; max
    pressure on the same LiDARs stands beside it.
    """
    plan, baseline = variants[0], best_baseline(variants)
    found = {one.sight: one for one in variants if one.is_perceived and one.policy == PREDICTIVE}
    lead = found.pop(comparison.lead_sight)
    tuned = ", tuned" if baseline.setting else ""
    text = (
        f"With {_equipment(comparison, lead.sight)} and predictive control a vehicle loses "
        f"{lead.delay_s:.1f} s, {_against(lead, plan)} the net's own plan "
        f"({plan.delay_s:.1f} s) and {_against(lead, baseline)} {_NAMES[baseline.policy]}{tuned} "
        f"({baseline.delay_s:.1f} s); all LiDARs together upload "
        f"{lead.mean('uplink_mbps') or 0:.1f} Mbit/s at a scan every "
        f"{comparison.question.frame_period_s:g} s."
    )
    pressure = next(
        one for one in variants if (one.policy, one.sight) == (MAX_PRESSURE, lead.sight)
    )
    text += f" Max pressure on what they see: {pressure.delay_s:.1f} s."
    for one in found.values():
        text += (
            f" With {_equipment(comparison, one.sight)} it is {one.delay_s:.1f} s and "
            f"{one.mean('uplink_mbps') or 0:.1f} Mbit/s."
        )
    return text


def _equipment(comparison: Comparison, sight: str) -> str:
    number = len(comparison.posts)
    posts = "1 roadside post" if number == 1 else f"{number} roadside posts"
    cavs = f"{100 * comparison.question.cav_rate:g} % CAVs (vehicles with LiDAR and radio)"
    return {POSTS: posts, CAVS: cavs, BOTH: f"{posts} and {cavs}"}[sight]


def _against(one: Variant, other: Variant) -> str:
    """Returns how far a delay lies below or above another, and whether that is certain."""
    less_s = -_difference(one, other)
    word = "less than" if less_s >= 0 else "more than"
    pairs = zip(one.values("delay_s"), other.values("delay_s"), strict=True)
    signs = {a < b for a, b in pairs}
    doubt = " (seeds disagree)" if len(signs) > 1 else ""
    return f"{abs(less_s):.1f} s{doubt} {word}"


def _difference(one: Variant, other: Variant) -> float:
    return paired(one.values("delay_s"), other.values("delay_s")).mean


def result_table(variants: Sequence[Variant]) -> Table:
    """Returns a line for each variant."""
    plan, baseline = variants[0], best_baseline(variants)
    rows = tuple(
        (
            _NAMES[one.policy],
            one.sight or None,
            one.setting or None,
            f"{one.mean('arrived'):.0f} of {one.mean('vehicles'):.0f}",
            _spread(one),
            one.delay_s,
            one.mean("delay_p95_s"),
            None if one is plan else _difference(one, plan),
            None if one is baseline else _difference(one, baseline),
        )
        for one in variants
    )
    forms = ("", "", "", "", "", ".1f", ".1f", "+.1f", "+.1f")
    return Table(tuple(map(Column, _HEADS, forms)), rows)


def _spread(one: Variant) -> str:
    values = one.values("delay_s")
    if len(values) >= MIN_SEEDS:
        return f"± {paired(values, [0.0] * len(values)).half or 0:.1f}"
    return ", ".join(f"{value:.1f}" for value in values)


def seen_table(variants: Sequence[Variant]) -> Table:
    """Returns what was seen, and what it took to upload."""
    rows = tuple(
        (
            _NAMES[one.policy],
            one.sight,
            None if (share := one.mean("e_cvpr")) is None else 100 * share,
            one.mean("false_detections"),
            one.mean("uplink_mbps"),
            one.mean("uplink_peak_mbps"),
        )
        for one in variants
        if one.is_perceived
    )
    return Table(tuple(map(Column, _SEEN_HEADS, ("", "", ".1f", ".2f", ".2f", ".2f"))), rows)


def print_comparison_table(
    comparison: Comparison, variants: Sequence[Variant], console: Console
) -> None:
    """Prints the tables and the sentence."""
    for heads, table in ((_HEADS, result_table(variants)), (_SEEN_HEADS, seen_table(variants))):
        printed = empty_table(heads, left=5 if heads is _HEADS else 2)
        for cells in text_rows(table):
            printed.add_row(*cells)
        print_whole(printed, console)
    console.print(answer(comparison, variants), markup=False, highlight=False)


def as_json(comparison: Comparison, variants: Sequence[Variant]) -> dict[str, Any]:
    """Returns the answer for programs."""
    measures = ("delay_s", "delay_p95_s", "e_cvpr", "uplink_mbps", "uplink_peak_mbps")
    rows = [
        {
            "policy": one.policy,
            "sees": one.sight or None,
            "setting": one.setting,
            **{measure: one.mean(measure) for measure in measures},
            "delay_by_seed_s": one.values("delay_s"),
        }
        for one in variants
    ]
    return {
        "net": comparison.name,
        "junctions": sorted(comparison.road_map.by_tls),
        "posts": comparison.posts,
        "answer": answer(comparison, variants),
        "rows": rows,
    }


def compare_page(
    comparison: Comparison, variants: Sequence[Variant], command: str, versions: dict[str, str]
) -> Page:
    """Returns the page: the sentence, delays, approaches, queues, what was seen, its origin."""
    plan, baseline = variants[0], best_baseline(variants)
    lead = next(
        one for one in variants if one.policy == PREDICTIVE and one.sight == comparison.lead_sight
    )
    drawn = [plan, baseline, *(one for one in variants if one.policy == PREDICTIVE)]
    sections = (
        Section("Delay", (_delays(variants), result_table(variants), Text(_MEASURE))),
        Section("By approach", _approaches(drawn)),
        Section("Queues over time", (_queues(drawn),)),
        Section("What was seen", (seen_table(variants), *_maps(comparison, variants))),
        _origin(comparison, command, versions),
    )
    facts = (
        Fact("the net's own plan", f"{plan.delay_s:.1f} s", "delay a vehicle"),
        Fact(_NAMES[baseline.policy], f"{baseline.delay_s:.1f} s", "the best without LiDAR"),
        Fact(f"predictive: {lead.sight}", f"{lead.delay_s:.1f} s", "delay a vehicle"),
        Fact("roadside posts", str(len(comparison.posts))),
        Fact("uplink", f"{lead.mean('uplink_mbps') or 0:.1f} Mbit/s", "all LiDARs together"),
    )
    title = f"{comparison.name}: what LiDAR is worth"
    return Page(title, answer(comparison, variants), sections, facts)


_MEASURE = (
    "Delay is time loss plus departure delay of every vehicle that had not arrived when the "
    "warm-up ended: those still on the way at the end and those kept outside count too. Every "
    "variant has the same demand, seed by seed; differences are means of pairs. Timers, loops and "
    "the fence of max pressure are tuned on seeds of their own; the best baseline is the best on "
    "the seeds that are reported, which favours it. "
    f'"{ALL_KNOWN.capitalize()}" is the same policy on SUMO alone that knows where each vehicle '
    "near the signals is: what better perception could still bring."
)


def _delays(variants: Sequence[Variant]) -> Chart:
    names = tuple(map(name_of, variants))
    places = tuple(range(len(variants)))
    means = tuple(one.delay_s for one in variants)
    values = [one.values("delay_s") for one in variants]
    notes = "Bars are means over the seeds; whiskers are "
    if len(values[0]) >= MIN_SEEDS:
        halves = [paired(own, [0.0] * len(own)).half or 0.0 for own in values]
        low = tuple(a - b for a, b in zip(means, halves, strict=True))
        high = tuple(a + b for a, b in zip(means, halves, strict=True))
        series = (Series("mean delay", places, means, low, high),)
        return Chart(
            "Mean delay of a vehicle", "", "s", series, "bar", x_categories=names,
            notes=notes + "their 95 % intervals.",
        )  # fmt: skip
    x = tuple(place for place, own in zip(places, values, strict=True) for _ in own)
    points = Series("a seed", x, tuple(v for own in values for v in own), style="points")
    mean_points = Series("mean of the seeds", places, means, style="points")
    return Chart(
        "Mean delay of a vehicle", "", "s", (points, mean_points), x_categories=names,
        notes=f"With fewer than {MIN_SEEDS} seeds there is no interval: each seed is a point.",
    )  # fmt: skip


def _approaches(drawn: Sequence[Variant]) -> tuple[Block, ...]:
    names = tuple(drawn[0].rows[0]["approaches"])
    values = [
        tuple(_mean_of([row["approaches"].get(name) for row in one.rows]) for name in names)
        for one in drawn
    ]
    if len(names) > _MAX_APPROACHES:
        columns = (Column("approach"), *(Column(name_of(one), ".1f") for one in drawn))
        return (Table(columns, tuple(zip(names, *values, strict=True)), "Time lost, s a vehicle"),)
    series = tuple(
        Series(name_of(one), tuple(range(len(names))), own)
        for one, own in zip(drawn, values, strict=True)
    )
    notes = "Of the last 300 m before the stop bars; vehicles kept outside are not in it."
    chart = Chart(
        "Time that a vehicle loses", "", "s", series, "bar", x_categories=names, notes=notes
    )
    return (chart,)


def _queues(drawn: Sequence[Variant]) -> Chart:
    series = []
    for one in drawn:
        length = min(len(row["queues"]) for row in one.rows)
        y = tuple(_mean_of([row["queues"][n] for row in one.rows]) for n in range(length))
        series.append(Series(name_of(one), tuple(INTERVAL_S * n for n in range(length)), y))
    return Chart(
        "Vehicles that stand before the stop bars",
        "s since the end of warm-up",
        "vehicles",
        tuple(series),
        notes="Of the last 300 m, a mean over the seeds.",
    )


def _mean_of(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _maps(comparison: Comparison, variants: Sequence[Variant]) -> tuple[Block, ...]:
    surfaces, lines = road_rings(comparison.road_map)
    maps = []
    for one in variants:
        found = one.rows[0].get("map")
        if not found:
            continue
        points = tuple(map(_points, found))
        x = [value for layer in points for value in layer.x_m]
        y = [value for layer in points for value in layer.y_m]
        window = (min(x), min(y), max(x), max(y)) if len(x) > 1 else None
        maps.append(MapChart(f"Seen by {one.sight}", surfaces, lines, points, (), window))
    return (SideBySide(tuple(maps)),) if maps else ()


def _points(layer: dict[str, Any]) -> Points:
    x_m, y_m, labels = (tuple(layer[key]) for key in ("x_m", "y_m", "labels"))
    return Points(layer["name"], x_m, y_m, layer["size"], layer["mark"], layer["colour"], labels)


def _origin(comparison: Comparison, command: str, versions: dict[str, str]) -> Section:
    asked = comparison.question
    rows = (
        ("signals", ", ".join(sorted(comparison.road_map.by_tls))),
        ("posts at", ", ".join(comparison.posts) or None),
        ("seeds", ", ".join(map(str, asked.seeds))),
        ("simulated time of a run", f"{asked.duration_s} s after {asked.warmup_s} s of warm-up"),
        ("a scan and a decision every", f"{asked.frame_period_s:g} s"),
        *versions.items(),
    )
    blocks = (
        Code(command, "The command that makes this again"),
        Table((Column(""), Column("")), rows),
    )
    return Section("How it was made", blocks)
