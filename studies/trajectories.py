"""Trajectories of a run's tracks, and traffic measures: speeds, queues, headways, arrivals.

All functions but the first two are pure, over tables in Polars: `trajectories` with a row per track
and frame, `greens` with a row per lane and green. A vehicle's position at a stop bar is
`distance_m`, as in `detections`: the distance of its centre to the bar, negative behind it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from protocol.approaches import Approaches
from protocol.config import is_folder
from protocol.errors import ConfigError
from protocol.messages import ObjectClass
from protocol.roadmap import Lane, RoadMap
from recording.run import Run

SCHEMA: dict[str, type[pl.DataType]] = {
    "track": pl.Int64,
    "sim_time_s": pl.Float64,
    "x_m": pl.Float64,
    "y_m": pl.Float64,
    "z_m": pl.Float64,
    "yaw_rad": pl.Float64,
    "speed_mps": pl.Float64,
    "length_m": pl.Float64,
    "width_m": pl.Float64,
    "class": pl.String,
    "lane": pl.String,
    "distance_m": pl.Float64,
    "coasted_s": pl.Float64,
    "region": pl.String,
}
GREENS: dict[str, type[pl.DataType]] = {
    "tls": pl.String,
    "lane": pl.String,
    "start_s": pl.Float64,
    "end_s": pl.Float64,
}
QUEUED_MPS = 5 / 3.6  # a slower vehicle before a stop bar is queued (5 km/h, as VISSIM counts)
QUEUE_GAP_M = (
    20.0  # between two vehicles of a queue, or the first and the bar, at most (VISSIM, too)
)
STARTUP = 4  # vehicles of a queue whose headways are longer, as they start (HCM)
ARRIVAL_M = 100.0  # before the stop bar, where arrivals are counted
THROUGH_DEG, U_TURN_DEG = 35.0, 135.0  # a turn by less, by more
GREEN = "Gg"
PATH = "--trajectories"
_ROWS = """
    SELECT d.track, f.sim_time_ns / 1e9, d.x_m, d.y_m, d.z_m, d.yaw_rad, d.speed_mps, d.length_m,
           d.width_m, d.object_class, d.lane, d.distance_m, d.coasted_s, d.region
    FROM detections AS d JOIN frames AS f ON f.frame = d.frame
    WHERE d.track > 0 AND f.sim_time_ns IS NOT NULL ORDER BY d.track, d.frame
"""
_STATES = "SELECT tls, sim_time_ns / 1e9, state FROM phases ORDER BY tls, frame"


def trajectories_of(run: Run) -> pl.DataFrame:
    """Returns a row per track and frame (`SCHEMA`), in the order of tracks and time.

    Raises:
        ConfigError: the run has no tracks.
    """
    rows = run.query(_ROWS)
    if not rows:
        raise ConfigError(
            f"{run.dir}: the run has no tracks; a run with edge.tracking.enabled has them"
        )
    names = {int(one): one.name.lower() for one in ObjectClass}
    schema = SCHEMA | {"class": pl.Int64}
    frame = pl.DataFrame(rows, schema, orient="row")
    return frame.with_columns(pl.col("class").replace_strict(names, return_dtype=pl.String))


def write_trajectories(run_dir: Path, path: Path) -> int:
    """Writes the trajectories of a run as Parquet; returns how many tracks they are of.

    Raises:
        ConfigError: the run has no tracks, or the file cannot be written.
    """
    if path.suffix.lower() != ".parquet" or is_folder(path):
        raise ConfigError(f"{PATH} {path}: must be the name of a .parquet file")
    with Run(run_dir) as run:
        frame = trajectories_of(run)
    try:
        frame.write_parquet(path)
    except OSError as error:
        raise ConfigError(f"{PATH} {path} cannot be written: {error}") from None
    return int(frame["track"].n_unique())


@dataclass(frozen=True, slots=True)
class Layout:
    """Lanes of the map: edges, limits in m/s, and approaches, turns and signal links.

    `approach` is the lane at the stop bar that a lane leads to, or is; `behind` are those lanes
    that come after it. `links` are a signal and its link numbers by lane at its stop bar.
    `headings_deg` are the directions at a lane's begin and end, counter-clockwise from east.
    """

    edge: Mapping[str, str]
    limit_mps: Mapping[str, float]
    approach: Mapping[str, str]
    behind: frozenset[str]
    links: Mapping[str, tuple[str, tuple[int, ...]]]
    headings_deg: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, road_map: RoadMap) -> Layout:
        """Reads a map."""
        approach: dict[str, str] = {}
        links: dict[str, tuple[str, tuple[int, ...]]] = {}
        behind: set[str] = set()
        for one in road_map.intersections:
            around = Approaches(road_map, one)
            for lane, reach in around.upstream.items():
                approach.setdefault(lane, reach.counts_for)
            behind.update(around.downstream)
            for lane in one.incoming:
                numbers = tuple(k.index for k in one.signal.links if k.from_lane == lane)
                links[lane] = one.tls, numbers
        return cls(
            {lane.id: lane.edge for lane in road_map.lanes},
            {lane.id: lane.speed_mps for lane in road_map.lanes},
            approach,
            frozenset(behind - set(approach)),
            links,
            {lane.id: _headings_deg(lane) for lane in road_map.lanes},
        )

    def turn(self, lane: str, to: str) -> str:
        """Returns the name of the turn from the end of a lane to the begin of another."""
        turn_deg = self.headings_deg[to][0] - self.headings_deg[lane][1]
        turn_deg = math.remainder(turn_deg, 360.0)
        if abs(turn_deg) > U_TURN_DEG:
            return "U-turn"
        if abs(turn_deg) < THROUGH_DEG:
            return "through"
        return "left" if turn_deg > 0 else "right"


def _headings_deg(lane: Lane) -> tuple[float, float]:
    """Returns the directions of a lane's first and last part."""
    steps = np.diff(lane.points[:, :2], axis=0)
    begin, end = np.degrees(np.arctan2(steps[[0, -1], 1], steps[[0, -1], 0])).tolist()
    return begin, end


def greens_of_run(run: Run, layout: Layout) -> pl.DataFrame:
    """Returns the greens that a run's signals showed (`GREENS`)."""
    schema = {"tls": pl.String, "time_s": pl.Float64, "state": pl.String}
    return greens(pl.DataFrame(run.query(_STATES), schema, orient="row"), layout.links)


def greens(states: pl.DataFrame, links: Mapping[str, tuple[str, tuple[int, ...]]]) -> pl.DataFrame:
    """Returns when each lane had green, by lane and time; a green from the start on is left out.

    The last one of a lane ends with the states.

    Args:
        states: what signals showed: `tls`, `time_s`, `state`, by signal and time.
        links: a signal and its link numbers by lane.
    """
    rows: list[tuple[str, str, float, float]] = []
    by_signal = {tls: part for (tls,), part in states.partition_by("tls", as_dict=True).items()}
    for lane, (tls, numbers) in links.items():
        shown = by_signal.get(tls)
        if shown is None:
            continue
        start_s, was_green = None, True
        times_s = shown["time_s"].to_list()
        for time_s, state in zip(times_s, shown["state"].to_list(), strict=True):
            is_green = any(k < len(state) and state[k] in GREEN for k in numbers)
            if is_green and not was_green:
                start_s = time_s
            if not is_green and start_s is not None:
                rows.append((tls, lane, start_s, time_s))
                start_s = None
            was_green = is_green
        if start_s is not None:
            rows.append((tls, lane, start_s, times_s[-1]))
    return pl.DataFrame(rows, GREENS, orient="row").sort("lane", "start_s")


def speeds_by_lane(trajectories: pl.DataFrame) -> pl.DataFrame:
    """Returns by `lane` its `tracks`, their `mean_mps` in space, and `p15_mps` to `p85_mps`.

    The mean in space is that over all rows: slow vehicles have more of them. Percentiles are of the
    tracks' own means. A vehicle whose track was lost and that was detected again has more than one
    track.
    """
    on_lane = _vehicles(trajectories).filter(pl.col("lane") != "")
    each = on_lane.group_by("lane", "track").agg(pl.col("speed_mps").mean().alias("own_mps"))
    parts = [pl.col("own_mps").quantile(q / 100, "linear").alias(f"p{q}_mps") for q in (15, 50, 85)]
    return (
        on_lane.group_by("lane")
        .agg(
            pl.col("track").n_unique().alias("tracks"),
            pl.col("speed_mps").mean().alias("mean_mps"),
        )
        .join(each.group_by("lane").agg(parts), on="lane")
        .sort("lane")
    )  # fmt: skip


def queues_at_green(
    trajectories: pl.DataFrame, greens: pl.DataFrame, approach: Mapping[str, str]
) -> pl.DataFrame:
    """Returns for every green (`lane`, `start_s`) the queue: `queued` vehicles over `length_m`.

    The length is that from the stop bar to the end of the last queued vehicle; those that stand on
    lanes farther up that lead to this one count, too.
    """
    schema = {"lane": pl.String, "start_s": pl.Float64, "queued": pl.Int64, "length_m": pl.Float64}
    rows = [
        (lane, start_s, queue.height, float(queue["end_m"].max() or 0.0))
        for lane, start_s, _, queue in _queues(trajectories, greens, approach)
    ]
    return pl.DataFrame(rows, schema, orient="row")


def _queues(
    trajectories: pl.DataFrame, greens: pl.DataFrame, approach: Mapping[str, str]
) -> list[tuple[str, float, float, pl.DataFrame]]:
    """Returns lane, start and end of every green, and the queue as it began, front first."""
    before = _before_bars(trajectories, approach)
    times_s = before["sim_time_s"].unique().sort()
    by_place = before.partition_by("sim_time_s", "approach", as_dict=True)
    result = []
    for lane, start_s, end_s in greens.select("lane", "start_s", "end_s").iter_rows():
        at = times_s.search_sorted(start_s, "right") - 1
        here = by_place.get((times_s[at], lane)) if at >= 0 else None
        queue = _queue(before.clear() if here is None else here)
        result.append((lane, start_s, end_s, queue))
    return result


def _queue(before: pl.DataFrame) -> pl.DataFrame:
    """Returns those of a lane's vehicles that are queued, front first, with their `end_m`."""
    half_m = pl.col("length_m") / 2
    slow = before.filter(pl.col("speed_mps").abs() < QUEUED_MPS).sort("distance_m")
    ends = slow.with_columns((pl.col("distance_m") + half_m).alias("end_m"))
    gap_m = pl.col("distance_m") - half_m - pl.col("end_m").shift(1, fill_value=0.0)
    return ends.filter((gap_m > QUEUE_GAP_M).cum_sum() == 0)


def crossings(trajectories: pl.DataFrame, layout: Layout) -> pl.DataFrame:
    """Returns when tracks' centres crossed stop bars: `track`, `lane`, `time_s`, `to`.

    `lane` is the lane at the stop bar, `to` the first lane outside the junction on which a track
    was seen behind it, null if there is none. A track that jumps over the bar without a frame on
    either side is not there.
    """
    known = _vehicles(trajectories).with_columns(
        pl.col("lane").replace_strict(dict(layout.approach), default=None).alias("approach"),
        pl.col("lane").is_in(list(layout.behind)).alias("behind"),
    )
    known = known.filter(pl.col("approach").is_not_null() | pl.col("behind"))
    after = {name: pl.col(name).shift(-1).over("track") for name in ("sim_time_s", "distance_m")}
    is_last = pl.col("approach").is_not_null() & pl.col("behind").shift(-1).over("track")
    share = pl.col("distance_m") / (pl.col("distance_m") - after["distance_m"])
    step_s = after["sim_time_s"] - pl.col("sim_time_s")
    crosses = is_last & (pl.col("distance_m") >= 0) & (after["distance_m"] < 0)
    at_s = pl.col("sim_time_s") + share * step_s
    crossed = known.with_columns(at_s.alias("time_s"), crosses.alias("crosses")).filter("crosses")
    out = known.filter(pl.col("behind") & ~pl.col("lane").str.starts_with(":")).select(
        "track",
        pl.col("sim_time_s").alias("out_s"),
        pl.col("lane").alias("to"),
    )
    return (
        crossed.select("track", "time_s", pl.col("approach").alias("lane"))
        .sort("time_s")
        .join_asof(
            out.sort("out_s"), left_on="time_s", right_on="out_s", by="track", strategy="forward",
            check_sortedness=False,
        )
        .select("track", "lane", "time_s", "to")
    )  # fmt: skip


def movements(crossings: pl.DataFrame, layout: Layout) -> pl.DataFrame:
    """Returns how many `vehicles` went `from` which edge `to` which, and by which `turn`."""
    lanes = crossings.drop_nulls("to").select("lane", "to").rows()
    named = pl.DataFrame(
        [(layout.edge[lane], layout.edge[to], layout.turn(lane, to)) for lane, to in lanes],
        {"from": pl.String, "to": pl.String, "turn": pl.String},
        orient="row",
    )
    return named.group_by("from", "to", "turn").agg(pl.len().alias("vehicles")).sort("from", "to")


def headways(
    trajectories: pl.DataFrame,
    greens: pl.DataFrame,
    crossings: pl.DataFrame,
    approach: Mapping[str, str],
) -> pl.DataFrame:
    """Returns the headways of queued vehicles over the stop bar: `lane`, `position`, `headway_s`.

    Of those that stood when the green began, in the order in which they cross until it ends. That
    of the first is the time since the green began.
    """
    by_lane = crossings.partition_by("lane", as_dict=True)
    rows: list[tuple[str, float, int, float]] = []
    for lane, start_s, end_s, queue in _queues(trajectories, greens, approach):
        passed = by_lane.get((lane,))
        if passed is None:
            continue
        is_queued = pl.col("track").is_in(queue["track"].to_list())
        times_s = passed.filter(
            is_queued & (pl.col("time_s") >= start_s) & (pl.col("time_s") <= end_s)
        )["time_s"].sort()
        before_s = start_s
        for position, time_s in enumerate(times_s.to_list(), 1):
            rows.append((lane, start_s, position, time_s - before_s))
            before_s = time_s
    schema = {
        "lane": pl.String,
        "start_s": pl.Float64,
        "position": pl.Int64,
        "headway_s": pl.Float64,
    }
    return pl.DataFrame(rows, schema, orient="row")  # fmt: skip


_HEADWAYS = pl.String, pl.Float64, pl.Int64, pl.Float64


def saturation_flows(headways: pl.DataFrame) -> pl.DataFrame:
    """Returns by `lane` the saturation flow `vph`, from the `headways` behind the first four.

    As in the Highway Capacity Manual: the first vehicles take longer to start, and are left out.
    """
    return (
        headways.filter(pl.col("position") > STARTUP)
        .group_by("lane")
        .agg(pl.len().alias("headways"), (3600 / pl.col("headway_s").mean()).alias("vph"))
        .sort("lane")
    )


def arrivals(trajectories: pl.DataFrame, greens: pl.DataFrame, layout: Layout) -> pl.DataFrame:
    """Returns when in the cycle vehicles would reach the stop bar in free flow.

    Each passes `ARRIVAL_M` before the bar, and would be there at the speed limit a little later:
    `lane`, `track`, `time_s`, `since_green_s` the time since the start of the lane's last green,
    `cycle_s` that green's cycle, `on_green` whether it still lasts. Those before the first green
    or behind the start of the last one are left out.
    """
    before = _before_bars(trajectories, layout.approach)
    after = {name: pl.col(name).shift(-1).over("track") for name in ("sim_time_s", "distance_m")}
    passes = (pl.col("distance_m") > ARRIVAL_M) & (after["distance_m"] <= ARRIVAL_M)
    share = (pl.col("distance_m") - ARRIVAL_M) / (pl.col("distance_m") - after["distance_m"])
    at_s = pl.col("sim_time_s") + share * (after["sim_time_s"] - pl.col("sim_time_s"))
    limit_mps = pl.col("approach").replace_strict(dict(layout.limit_mps), default=None)
    due = before.with_columns(
        (at_s + ARRIVAL_M / limit_mps).alias("time_s"), passes.alias("passes")
    )
    cycles = greens.sort("start_s").with_columns(
        (pl.col("start_s").shift(-1).over("lane") - pl.col("start_s")).alias("cycle_s")
    )
    return (
        due.filter("passes")
        .select(pl.col("approach").alias("lane"), "track", "time_s")
        .sort("time_s")
        .join_asof(
            cycles, left_on="time_s", right_on="start_s", by="lane", strategy="backward",
            check_sortedness=False,
        )
        .drop_nulls("cycle_s")
        .select(
            "lane", "track", "time_s",
            (pl.col("time_s") - pl.col("start_s")).alias("since_green_s"),
            "cycle_s",
            (pl.col("time_s") < pl.col("end_s")).alias("on_green"),
        )
    )  # fmt: skip


def _vehicles(trajectories: pl.DataFrame) -> pl.DataFrame:
    """Returns the rows of vehicles: people are none."""
    return trajectories.filter(pl.col("class") != ObjectClass.PEDESTRIAN.name.lower())


def _before_bars(trajectories: pl.DataFrame, approach: Mapping[str, str]) -> pl.DataFrame:
    """Returns the rows before stop bars, with the lane at the bar as `approach`."""
    named = pl.col("lane").replace_strict(dict(approach), default=None).alias("approach")
    before = _vehicles(trajectories).with_columns(named)
    return before.filter(pl.col("approach").is_not_null() & (pl.col("distance_m") >= 0))
