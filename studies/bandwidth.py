"""What each agent sent."""

from __future__ import annotations

from recorder.run import Run

Figures = dict[str, float | None]

_PER_AGENT = """
    SELECT agent, count(DISTINCT frame), sum(points), sum(payload_bytes), sum(wire_bytes),
           count(DISTINCT CASE WHEN wire_bytes IS NOT NULL THEN frame END)
    FROM uploads WHERE payload_bytes IS NOT NULL GROUP BY agent ORDER BY agent
"""


def by_agent(run: Run, frame_period_s: float) -> dict[str, Figures]:
    """Returns by agent its frames, points and bytes per frame, and its rate in Mbit/s.

    The rate is that of the frames in which the agent sent something, at the run's frame rate:
    what its link must carry when the run keeps pace with the clock. `wire_*` is what TCP sent:
    poses, message headers and repetitions included, the headers of TCP and IP not; None if the
    transport could not tell.
    """
    return {
        agent: {
            "frames": frames,
            "points_per_frame": points / frames,
            "bytes_per_frame": payload / frames,
            "mbps": _mbps(payload / frames, frame_period_s),
            "wire_bytes_per_frame": wire / counted if wire else None,
            "wire_mbps": _mbps(wire / counted, frame_period_s) if wire else None,
        }
        for agent, frames, points, payload, wire, counted in run.query(_PER_AGENT)
    }


def total_mbps(run: Run, frame_period_s: float) -> Figures:
    """Returns mean and peak of what all agents together sent in a frame, as a rate."""
    sql = "SELECT sum(payload_bytes) FROM uploads WHERE payload_bytes IS NOT NULL GROUP BY frame"
    rates = [_mbps(sent, frame_period_s) for (sent,) in run.query(sql)]
    frames = run.query("SELECT count(*) FROM frames WHERE tick_ns IS NOT NULL")[0][0]
    return {
        "mean": sum(rates) / frames if frames else None,
        "peak": max(rates, default=None),
    }


def _mbps(bytes_per_frame: float, frame_period_s: float) -> float:
    return bytes_per_frame * 8e-6 / frame_period_s
