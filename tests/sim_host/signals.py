"""Signals of every kind, drawn by hypothesis."""

from itertools import combinations

from hypothesis import strategies as st

from protocol.roadmap import PlanPhase, Signal


def plan(*greens: str) -> list[PlanPhase]:
    phases = []
    for green in greens:
        phases.append(PlanPhase(duration_s=20, state=green))
        phases.append(PlanPhase(duration_s=5, state="r" * len(green)))
    return phases


@st.composite
def signals(draw: st.DrawFn) -> Signal:
    """Draws conflicts among a few links, and a plan in which the later link of two yields."""
    size = draw(st.integers(2, 5))
    pairs = list(combinations(range(size), 2))
    conflicts = [pair for pair in pairs if draw(st.booleans())]
    greens = []
    for _ in range(draw(st.integers(1, 4))):
        state = ""
        for link in range(size):
            foes = [a for a, b in conflicts if b == link and state[a] in "Gg"]
            state += draw(st.sampled_from("rg" if foes else "rgG"))
        greens.append(state)
    kept = [green for green in greens if set(green) & set("gG")] or ["G" + "r" * (size - 1)]
    return Signal(tls="J", links=[], conflicts=conflicts, plan=plan(*kept))
