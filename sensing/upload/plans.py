"""The edge's plans as an agent heard them, and which of them it follows in a frame."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import Plan

MAX_AGE_FRAMES = 10  # an older plan is of a scene that has passed
MAX_AHEAD_FRAMES = 64  # a plan for later than this is an error


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """A plan, and when it arrived over a virtual link; 0 where links are real."""

    plan: Plan
    arrival_sim_ns: int


class Plans:
    """Keeps the plans of the last frames. A plan holds from its frame on."""

    def __init__(self) -> None:
        self._heard: list[_Heard] = []

    @property
    def newest(self) -> Plan | None:
        """The newest plan, be its frame still to come."""
        return self._heard[-1].plan if self._heard else None

    def hear(self, plan: Plan, *, frame: int, arrival_sim_ns: int) -> bool:
        """Takes a plan while a frame is played; one that is older, or absurd, is left."""
        newest = self.newest
        is_news = newest is None or plan.frame > newest.frame
        if not is_news or plan.frame > frame + MAX_AHEAD_FRAMES:
            return False
        self._heard = [h for h in self._heard if h.plan.frame >= frame - MAX_AGE_FRAMES]
        self._heard.append(_Heard(plan, arrival_sim_ns))
        return True

    def of(self, frame: int, sim_time_ns: int) -> Plan | None:
        """Returns the plan to follow in a frame that begins then."""
        for heard in reversed(self._heard):
            age_frames = frame - heard.plan.frame
            if 0 <= age_frames <= MAX_AGE_FRAMES and heard.arrival_sim_ns <= sim_time_ns:
                return heard.plan
        return None
