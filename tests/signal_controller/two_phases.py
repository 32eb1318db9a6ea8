"""A signal of two phases."""

from __future__ import annotations

from protocol.roadmap import Link, PlanPhase, Signal

MAIN, SIDE = "GGr", "rrG"


SIGNAL = Signal(
    tls="j",
    links=[
        Link(index=0, from_lane="main", to_lane="out_0"),
        Link(index=1, from_lane="main", to_lane="out_1"),
        Link(index=2, from_lane="side", to_lane="out_0"),
    ],
    conflicts=[(0, 2)],
    plan=[
        PlanPhase(duration_s=30, state=MAIN),
        PlanPhase(duration_s=4, state="yyr"),
        PlanPhase(duration_s=20, state=SIDE),
        PlanPhase(duration_s=4, state="rry"),
    ],
)
