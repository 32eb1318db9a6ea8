"""The answer of `cpnet compare`: its tables on a terminal, its page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from studies.approach_log import INTERVAL_S
from studies.bench import empty_table, print_whole
from studies.compare import ALL_KNOWN, PREDICTIVE, Variant
from studies.compare_answer import (
    MIN_SEEDS,
    NAMES,
    PROMPT_S,
    answer,
    approaches,
    best_baseline,
    difference,
    link_mbps,
    mbps,
    mean_of,
    name_of,
)
from studies.compare_question import Comparison
from studies.control_study import file_digest, paired
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

_DELAY = "delay of a vehicle, s"
_MAX_APPROACHES = 12  # that are drawn; more are in a table
_HEADS = (
    *("control", "it sees", "what its tuning set", "arrived by the end"),
    *("delay by seed, s", "delay, s"),
    *("95th percentile, s", "over own plan, s", "over best baseline, s"),
)
_SEEN_HEADS = (
    *("control", "it sees", "E-CVPR, %", "false boxes a frame"),
    *("sent on average, Mbit/s", "peak, Mbit/s", "largest scan, kB"),
    *("its link for 100 ms, Mbit/s", "for a frame period, Mbit/s"),
)


_PRINTED = {  # a terminal's share of the columns above, under heads as narrow as their numbers
    "arrived by the end": "arrived",
    "delay by seed, s": "by seed, s",
    "delay, s": "delay, s",
    "95th percentile, s": "p95, s",
    "over own plan, s": "over own\nplan, s",
    "over best baseline, s": "over best\nbaseline, s",
}
_SEEN_PRINTED = {
    "E-CVPR, %": "E-CVPR\n%",
    "false boxes a frame": "false boxes\na frame",
    "sent on average, Mbit/s": "sent\nMbit/s",
    "peak, Mbit/s": "peak\nMbit/s",
    "largest scan, kB": "largest\nscan, kB",
    "its link for 100 ms, Mbit/s": "its link for\n100 ms, Mbit/s",
    "for a frame period, Mbit/s": "for a frame\nperiod, Mbit/s",
}


def result_table(variants: Sequence[Variant]) -> Table:
    """Returns a line for each variant."""
    plan, baseline = variants[0], best_baseline(variants)
    rows = tuple(
        (
            NAMES[one.policy],
            one.sight or None,
            one.setting or None,
            f"{one.mean('arrived'):.0f} of {one.mean('vehicles'):.0f}",
            _spread(one),
            one.delay_s,
            one.mean("delay_p95_s"),
            None if one is plan else difference(one, plan),
            None if one is baseline else difference(one, baseline),
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


def seen_table(comparison: Comparison, variants: Sequence[Variant]) -> Table:
    """Returns a table of the share of vehicles seen, and the upload that it took."""
    rows = tuple(
        (
            NAMES[one.policy],
            one.sight,
            None if (share := one.mean("e_cvpr")) is None else 100 * share,
            one.mean("false_detections"),
            one.mean("uplink_mbps"),
            one.greatest("uplink_peak_mbps"),
            one.greatest("scan_peak_kb"),
            link_mbps(one, PROMPT_S),
            link_mbps(one, comparison.question.frame_period_s),
        )
        for one in variants
        if one.is_perceived
    )
    return Table(
        tuple(map(Column, _SEEN_HEADS, ("", "", ".1f", ".2f", ".2f", ".2f", ".1f", ".2f", ".2f"))),
        rows,
    )


def print_comparison_table(
    comparison: Comparison, variants: Sequence[Variant], console: Console
) -> None:
    """Prints the tables and the sentence."""
    perceived = [one for one in variants if one.is_perceived]
    tables = result_table(variants), seen_table(comparison, variants)
    heads_of = _PRINTED, _SEEN_PRINTED
    for shown, heads, table in zip((variants, perceived), heads_of, tables, strict=True):
        places = {column.name: place for place, column in enumerate(table.columns)}
        printed = empty_table(["control", *heads.values()])
        for one, cells in zip(shown, text_rows(table), strict=True):
            printed.add_row(name_of(one), *(cells[places[head]] for head in heads))
        print_whole(printed, console)
    console.print(answer(comparison, variants), markup=False, highlight=False)


def as_json(comparison: Comparison, variants: Sequence[Variant]) -> dict[str, Any]:
    """Returns the answer for programs."""
    measures = ("delay_s", "delay_p95_s", "e_cvpr", "uplink_mbps", "scan_kb")
    peaks = ("uplink_peak_mbps", "scan_peak_kb")
    rows = [
        {
            "policy": one.policy,
            "sees": one.sight or None,
            "setting": one.setting,
            **{measure: one.mean(measure) for measure in measures},
            **{measure: one.greatest(measure) for measure in peaks},
            "link_100ms_mbps": link_mbps(one, PROMPT_S),
            "link_frame_mbps": link_mbps(one, comparison.question.frame_period_s),
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
    seen = seen_table(comparison, variants)
    drawn = [plan, baseline, *(one for one in variants if one.policy == PREDICTIVE)]
    is_tuned = comparison.question.tuning_s > 0
    tuned = "are tuned on seeds of their own" if is_tuned else "are not tuned (--tuning 0)"
    measure = Text(_MEASURE.format(tuned=tuned))
    sections = (
        Section("Delay", (_delays(variants), result_table(variants), measure)),
        Section("By approach", _approaches(drawn)),
        Section("Queues over time", (_queues(drawn),)),
        Section("What was seen", (Text(_SEEN), seen, *_maps(comparison, variants))),
        _origin(comparison, command, versions),
    )
    facts = (
        Fact("the net's own plan", f"{plan.delay_s:.1f} s", "delay a vehicle"),
        Fact(NAMES[baseline.policy], f"{baseline.delay_s:.1f} s", "the best without LiDAR"),
        Fact(f"predictive: {lead.sight}", f"{lead.delay_s:.1f} s", "delay a vehicle"),
        Fact("roadside posts", str(len(comparison.posts))),
        *_uplink_facts(comparison, lead),
    )
    title = f"{comparison.name}: what LiDAR is worth"
    return Page(title, answer(comparison, variants), sections, facts)


def _uplink_facts(comparison: Comparison, lead: Variant) -> list[Fact]:
    period_s = comparison.question.frame_period_s
    sent, peak = lead.mean("uplink_mbps") or 0.0, lead.greatest("uplink_peak_mbps") or 0.0
    facts = [
        Fact("sent on average", mbps(sent), f"all LiDARs together; peak {mbps(peak)}"),
    ]
    prompt, slow = link_mbps(lead, PROMPT_S), link_mbps(lead, period_s)
    if prompt is not None and slow is not None:
        note = (
            f"for {lead.greatest('scan_peak_kb'):.0f} kB, its largest scan, to be there within "
            f"{1e3 * PROMPT_S:g} ms; {mbps(slow)} within the frame period of {period_s:g} s"
        )
        facts.append(Fact("link of a LiDAR", mbps(prompt), note))
    return facts


_SEEN = (
    "E-CVPR is the share of the vehicles present, from 200 m before the stop bars to 100 m behind, "
    "that perception detects: what as many connected vehicles would be worth. Rates are payload "
    "without headers. What all send on average is not what to buy: the link of each LiDAR must "
    "carry its largest scan (kB times 8, over the time that it may take)."
)
_MEASURE = (
    "Delay is time loss plus departure delay of every vehicle that had not arrived when the "
    "warm-up ended: those still on the way at the end and those kept outside count too, which is "
    "the rest where fewer have arrived than there are. Every "
    "variant has the same demand, seed by seed; differences are means of pairs. Timers, loops, and "
    "fence and phases of max pressure {tuned}; the best baseline is the best on "
    "the seeds that are reported, which favours it. "
    f'"{ALL_KNOWN.capitalize()}" is the same policy on SUMO alone that knows where each vehicle '
    "near the signals is: about what better perception could still bring. It is no bound: "
    "differences smaller than the spread of the seeds are noise."
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
            "Mean delay of a vehicle", "", _DELAY, series, "bar", x_categories=names,
            from_zero=True, notes=notes + "their 95 % intervals.",
        )  # fmt: skip
    x = tuple(place for place, own in zip(places, values, strict=True) for _ in own)
    if len(values[0]) == 1:
        points = Series("a seed", places, means, style="points")
        return Chart(
            "Mean delay of a vehicle", "", _DELAY, (points,), x_categories=names, from_zero=True,
            notes="Of one seed: it has no spread to be judged by.",
        )  # fmt: skip
    points = Series("a seed", x, tuple(v for own in values for v in own), style="points")
    mean_points = Series("mean of the seeds", places, means, style="points")
    return Chart(
        "Mean delay of a vehicle", "", _DELAY, (points, mean_points), x_categories=names,
        from_zero=True,
        notes=f"With fewer than {MIN_SEEDS} seeds there is no interval: each seed is a point.",
    )  # fmt: skip


def _approaches(drawn: Sequence[Variant]) -> tuple[Block, ...]:
    names = tuple(approaches(drawn[0]))
    values = [tuple(map(approaches(one).get, names)) for one in drawn]
    if len(names) > _MAX_APPROACHES:
        columns = (Column("approach"), *(Column(name_of(one), ".1f") for one in drawn))
        return (Table(columns, tuple(zip(names, *values, strict=True)), "Time lost, s a vehicle"),)
    series = tuple(
        Series(name_of(one), tuple(range(len(names))), own)
        for one, own in zip(drawn, values, strict=True)
    )
    notes = "Of the last 300 m before the stop bars; vehicles kept outside are not in it."
    return (
        Chart(
            "Time that a vehicle loses", "", "time lost by a vehicle, s", series, "bar",
            x_categories=names, notes=notes, from_zero=True,
        ),
    )  # fmt: skip


def _queues(drawn: Sequence[Variant]) -> Chart:
    series = []
    for one in drawn:
        length = min(len(row["queues"]) for row in one.rows)
        y = tuple(mean_of([row["queues"][n] for row in one.rows]) for n in range(length))
        series.append(Series(name_of(one), tuple(INTERVAL_S * n for n in range(length)), y))
    return Chart(
        "Vehicles that stand before the stop bars",
        "time since the end of warm-up, s",
        "vehicles that stand",
        tuple(series),
        from_zero=True,
        notes="Of the last 300 m, a mean over the seeds.",
    )


def _maps(comparison: Comparison, variants: Sequence[Variant]) -> tuple[Block, ...]:
    surfaces, lines = road_rings(comparison.road_map)
    seen = [(one, tuple(map(_points, one.rows[0].get("map") or ()))) for one in variants]
    seen = [(one, points) for one, points in seen if points]
    x = [value for _, points in seen for layer in points for value in layer.x_m]
    y = [value for _, points in seen for layer in points for value in layer.y_m]
    window = (min(x), min(y), max(x), max(y)) if len(x) > 1 else None  # one scale for all
    maps = []
    for one, points in seen:
        title = f"Seen by {one.sight}"
        notes = (
            f"{NAMES[one.policy].capitalize()} control, {one.sight}, seed "
            f"{comparison.question.seeds[0]}: each vehicle near the signals in each frame drawn."
        )
        maps.append(MapChart(title, surfaces, lines, points, (), window, notes))
    return (SideBySide(tuple(maps)),) if maps else ()


def _points(layer: dict[str, Any]) -> Points:
    x_m, y_m, labels = (tuple(layer[key]) for key in ("x_m", "y_m", "labels"))
    return Points(layer["name"], x_m, y_m, layer["size"], layer["mark"], layer["colour"], labels)


def _origin(comparison: Comparison, command: str, versions: dict[str, str]) -> Section:
    asked = comparison.question
    files = [path for path in asked.files.values() if path is not None]
    demand = None if asked.demand_vph is None else f"{asked.demand_vph:g} veh/h and lane"
    rows = (
        ("signals", ", ".join(sorted(comparison.road_map.by_tls))),
        *((path.name, f"SHA-256 {file_digest(path)[:16]}") for path in files),
        *([("demand", demand)] if demand else []),
        ("posts at", ", ".join(comparison.posts) or None),
        ("share of CAVs", f"{100 * asked.cav_rate:g} %"),
        ("tuning", f"runs of {asked.tuning_s} s" if asked.tuning_s else "none"),
        *((key, json.dumps(value)) for key, value in sorted((asked.settings or {}).items())),
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
