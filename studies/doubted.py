"""Which agents the edge did not fully believe."""

from __future__ import annotations

from recorder.run import Run

_PER_AGENT = """
    SELECT agent, min(score), total(believed = 0) FROM doubts GROUP BY agent
    ORDER BY total(believed = 0) DESC, min(score), agent
"""


def doubted(run: Run) -> dict[str, dict[str, float]]:
    """Returns by agent its least score, and the frames that went on without it; worst first.

    Agents that were believed all along are not among them.
    """
    return {
        agent: {"least_score": score, "frames_left_out": int(frames)}
        for agent, score, frames in run.query(_PER_AGENT)
    }
