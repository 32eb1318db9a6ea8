"""The section of a run's page on traffic measures from trajectories."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from protocol.errors import ConfigError
from recording.run import Run
from studies.page.model import Block, Chart, Column, Section, Series, SideBySide, Table, Text
from studies.trajectories import (
    ARRIVAL_M,
    STARTUP,
    Layout,
    arrivals,
    crossings,
    greens_of_run,
    headways,
    movements,
    queues_at_green,
    saturation_flows,
    speeds_by_lane,
    trajectories_of,
)

TITLE = "Traffic, from trajectories"
MAX_LANES = 24  # that a chart or table shows: those with the most vehicles
MAX_SERIES = 8
BIN_S = 5.0


def trajectory_section(run: Run) -> Section:
    """Returns speeds, queues, movements, saturation flows and arrivals, or why there are none."""
    try:
        layout = Layout.of(run.setup.road_map)
        trajectories = trajectories_of(run)
    except ConfigError as error:
        return Section(TITLE, (Text(f"There are no trajectories: {error}."),))
    greens = greens_of_run(run, layout)
    crossed = crossings(trajectories, layout)
    times_s = trajectories["sim_time_s"]
    hours = (float(times_s.max() or 0.0) - float(times_s.min() or 0.0)) / 3600
    shown = headways(trajectories, greens, crossed, layout.approach)
    return Section(
        TITLE,
        (
            _speeds(speeds_by_lane(trajectories), layout.limit_mps),
            *_queues(queues_at_green(trajectories, greens, layout.approach)),
            _movements(movements(crossed, layout), hours),
            *_headways(shown),
            *_arrivals(arrivals(trajectories, greens, layout)),
        ),
    )


def _speeds(speeds: pl.DataFrame, limit_mps: Mapping[str, float]) -> Block:
    """Returns a chart of the speeds on each lane of the road, and a table."""
    roads = speeds.filter(~pl.col("lane").str.starts_with(":"))
    roads = roads.sort("tracks", descending=True).head(MAX_LANES).sort("lane")
    lanes = tuple(roads["lane"].to_list())
    kmh = {name: tuple((3.6 * roads[f"{name}_mps"]).to_list()) for name in ("p15", "p50", "p85")}
    chart = Chart(
        "Speeds by lane",
        "lane",
        "km/h",
        (Series("median", tuple(range(len(lanes))), kmh["p50"], kmh["p15"], kmh["p85"]),),
        "bar",
        x_categories=lanes,
        notes="Of the tracks' own means; whiskers from the 15th to the 85th percentile.",
    )
    rows = tuple(
        (lane, tracks, 3.6 * mean, 3.6 * limit_mps[lane] if lane in limit_mps else None)
        for lane, tracks, mean in roads.select("lane", "tracks", "mean_mps").iter_rows()
    )
    columns = (
        Column("lane"),
        Column("tracks"),
        Column("mean in space, km/h", ".1f"),
        Column("limit, km/h", ".0f"),
    )
    return SideBySide(
        (
            chart,
            Table(
                columns,
                rows,
                "Mean speeds, standing included; a vehicle lost and found again is two tracks",
            ),
        )
    )


def _queues(queues: pl.DataFrame) -> list[Block]:
    """Returns the queues at the start of green over time, and by lane."""
    if queues.is_empty():
        return [Text("No lane was seen to get green, so that there are no queues to tell of.")]
    by_lane = (
        queues.group_by("lane")
        .agg(
            pl.len().alias("greens"),
            pl.col("queued").mean().alias("mean"),
            pl.col("queued").max().alias("most"),
            pl.col("length_m").mean().alias("mean_m"),
            pl.col("length_m").max().alias("most_m"),
        )
        .sort("lane")
    )
    longest = by_lane.sort("mean", descending=True).head(MAX_SERIES)["lane"].sort().to_list()
    series = []
    for lane in longest:
        one = queues.filter(pl.col("lane") == lane).sort("start_s")
        x, y = tuple(one["start_s"].to_list()), tuple(one["queued"].to_list())
        series.append(Series(lane, x, y, style="line+points"))
    chart = Chart("Queues at the start of green", "simulated time, s", "vehicles", tuple(series))
    columns = (
        Column("lane"),
        Column("greens"),
        Column("mean, vehicles", ".1f"),
        Column("most", "d"),
        Column("mean, m", ".0f"),
        Column("longest, m", ".0f"),
    )
    table = Table(columns, tuple(by_lane.head(MAX_LANES).rows()), "Queues at the start of green")
    return [SideBySide((chart, table))]


def _movements(found: pl.DataFrame, hours: float) -> Block:
    """Returns the turning movements as a table."""
    if found.is_empty():
        return Text("No track was followed over a stop bar and on.")
    rows = tuple(
        (*row, row[3] / hours if hours else None)
        for row in found.select("from", "to", "turn", "vehicles").head(4 * MAX_LANES).iter_rows()
    )
    columns = (
        Column("from"),
        Column("to"),
        Column("turn"),
        Column("vehicles"),
        Column("per hour", ".0f"),
    )
    return Table(columns, rows, "Turning movements")


def _headways(found: pl.DataFrame) -> list[Block]:
    """Returns the headways of queued vehicles by position, and saturation flows by lane."""
    if found.is_empty():
        return [Text("No queued vehicle was followed over a stop bar.")]
    means = (
        found.group_by("position")
        .agg(pl.col("headway_s").mean().alias("mean"), pl.len().alias("vehicles"))
        .sort("position")
    )
    chart = Chart(
        "Headways of queued vehicles over the stop bar",
        "position in the queue",
        "s",
        (
            Series(
                "mean of all lanes",
                tuple(range(len(means))),
                tuple(means["mean"].to_list()),
            ),
        ),
        "bar",
        x_categories=tuple(map(str, means["position"].to_list())),
        notes="That of the first is its time since green.",
    )
    columns = (Column("lane"), Column("headways"), Column("vehicles per hour of green", ".0f"))
    flows = saturation_flows(found)
    if flows.is_empty():
        none = Text(f"No queue longer than {STARTUP} was followed: there is no saturation flow.")
        return [SideBySide((chart, none))]
    caption = f"Saturation flow, behind the first {STARTUP} of a queue"
    table = Table(columns, tuple(flows.head(MAX_LANES).rows()), caption)
    return [SideBySide((chart, table))]


def _arrivals(found: pl.DataFrame) -> list[Block]:
    """Returns when in the cycle vehicles arrive, and how many do so on green."""
    if found.is_empty():
        return [Text("No arrival lies between two greens of its lane.")]
    by_lane = (
        found.group_by("lane")
        .agg(
            pl.len().alias("arrivals"),
            (100 * pl.col("on_green").mean()).alias("on green"),
            pl.col("cycle_s").mean().alias("cycle"),
        )
        .sort("lane")
    )
    busiest = by_lane.sort("arrivals", descending=True).head(MAX_SERIES)["lane"].sort().to_list()
    bins = range(int(found["since_green_s"].max() // BIN_S) + 1)
    series = []
    for lane in busiest:
        times_s = found.filter(pl.col("lane") == lane)["since_green_s"]
        counts = (times_s // BIN_S).cast(pl.Int64).value_counts()
        known = dict(counts.iter_rows())
        x = tuple(BIN_S * (n + 0.5) for n in bins)
        series.append(Series(lane, x, tuple(known.get(n, 0) for n in bins)))
    chart = Chart(
        "Arrivals in the cycle",
        "s since the start of green",
        "vehicles",
        tuple(series),
        "bar",
        stacked=True,
        notes=f"When vehicles that pass {ARRIVAL_M:g} m before the stop bar would be there at the "
        "speed limit.",
    )
    columns = (
        Column("lane"),
        Column("arrivals"),
        Column("on green, %", ".0f"),
        Column("mean cycle, s", ".0f"),
    )
    table = Table(columns, tuple(by_lane.head(MAX_LANES).rows()), "Arrivals on green")
    return [SideBySide((chart, table))]
