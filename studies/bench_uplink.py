"""What an upload policy on a link comes to: bytes, latency, and what is still seen and counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from recorder.run import Run
from recorder.tables import CountRow, DetectionRow, TruthRow
from studies.bench_choices import LEARNING_FRAMES
from studies.count_error import PerceptionTally
from studies.ecvpr import by_frame
from studies.latency import end_to_end_ms
from studies.uplink import by_agent

EMP_LATENCY_MS, EMP_RATE_HZ = 93.0, 24.0  # published: mean end to end, frames a second
SUSTAINED_SHARE = 0.98  # of all frames

Visible = Callable[[int], set[str]]


@dataclass(frozen=True, slots=True)
class UplinkRow:
    """One policy on one link. A figure that the run does not yield is None.

    `fps` are the scans of an agent that the edge used, per second; `whole_fps` the frames of which
    it had all that it needed: with `reap` not every agent's scan is; `recall_visible` is the share
    of the vehicles without a radio, seen by all agents together, that the edge detects;
    `count_error` the mean absolute error of a lane's count, in vehicles.
    """

    policy: str
    link: str
    agents: int
    bytes_per_frame: float | None
    mbps_per_agent: float | None
    latency_ms: dict[str, float | None]
    fps: float | None
    whole_fps: float | None
    recall_visible: float | None
    count_error: float | None
    false_per_frame: float | None

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class RateRow:
    """One frame rate in realtime."""

    rate_hz: float
    uplink: UplinkRow

    @property
    def is_sustained(self) -> bool:
        """Whether nearly all frames were whole, and no queue grew: EMP's latency was kept."""
        mean_ms = self.uplink.latency_ms["mean"]
        whole = (self.uplink.whole_fps or 0.0) / self.rate_hz
        return whole >= SUSTAINED_SHARE and mean_ms is not None and mean_ms <= EMP_LATENCY_MS

    def as_json(self) -> dict[str, Any]:
        """Returns stable keys."""
        row = self.uplink.as_json()
        return {"rate_hz": self.rate_hz, "is_sustained": self.is_sustained, **row}


def row_of(
    run: Run, names: tuple[str, str], agents: int, visible: Visible, frame_period_s: float
) -> UplinkRow:
    """Reads a row from a run; `names` are policy and link."""
    policy, link = names
    sent = by_agent(run, frame_period_s)
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    sizes = [
        float(one["bytes_per_frame"] or 0) * float(one["frames"] or 0) for one in sent.values()
    ]
    mean_bytes = sum(sizes) / (len(sizes) * frames) if sizes and frames else None
    tally = _tally(run, visible)
    return UplinkRow(
        policy=policy,
        link=link,
        agents=agents,
        bytes_per_frame=mean_bytes,
        mbps_per_agent=None if mean_bytes is None else mean_bytes * 8e-6 / frame_period_s,
        latency_ms=end_to_end_ms(run, after_frame=LEARNING_FRAMES),
        fps=_scans_per_s(run, frame_period_s),
        whole_fps=_whole_per_s(run, frame_period_s),
        recall_visible=tally.recall_visible,
        count_error=tally.count_error,
        false_per_frame=tally.false_per_frame,
    )


def _scans_per_s(run: Run, frame_period_s: float) -> float | None:
    """Returns how many scans of an agent the edge used per second of simulated time."""
    sql = """
        SELECT (SELECT count(*) FROM (SELECT DISTINCT frame, agent FROM uploads
                WHERE received_ns IS NOT NULL AND frame >= ?)),
               (SELECT count(DISTINCT agent) FROM uploads)
    """
    used, agents = run.query(sql, LEARNING_FRAMES)[0]
    ticks = "SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL AND frame >= ?"
    frames = run.query(ticks, LEARNING_FRAMES)[0][0]
    return used / agents / frames / frame_period_s if agents and frames else None


def _whole_per_s(run: Run, frame_period_s: float) -> float | None:
    """Returns how many frames were complete per second of simulated time."""
    sql = """
        SELECT count(*), total(complete = 1) FROM frames WHERE tick_ns IS NOT NULL AND frame >= ?
    """
    frames, whole = run.query(sql, LEARNING_FRAMES)[0]
    return whole / frames / frame_period_s if frames else None


def _tally(run: Run, visible: Visible) -> PerceptionTally:
    tally = PerceptionTally(run.setup)
    found, counts = dict(by_frame(run.rows(DetectionRow))), dict(by_frame(run.rows(CountRow)))
    perceived = {n for (n,) in run.query("SELECT frame FROM frames WHERE detections IS NOT NULL")}
    for frame, vehicles in by_frame(run.rows(TruthRow)):
        if frame >= LEARNING_FRAMES and frame in perceived:
            tally.add(visible(frame), found.get(frame, []), counts.get(frame, []), vehicles)
    return tally
