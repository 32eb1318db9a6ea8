"""A crossing of four approaches, each with a lane straight on and one that turns left."""

from __future__ import annotations

import itertools

import numpy as np

from protocol.messages import LaneCounts, SignalState
from protocol.roadmap import Link, PlanPhase, Signal
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation, SignalSite
from tests.roads import lane, one_junction

S = 1_000_000_000
REACH_M = 200.0
_SIDES = {"n": (0, 1), "e": (1, 0), "s": (0, -1), "w": (-1, 0)}
_LEFT = {"n": "e", "e": "s", "s": "w", "w": "n"}  # the exit of a left turn, by its approach
_AHEAD = {"n": "s", "e": "w", "s": "n", "w": "e"}


def _lanes() -> list:
    found = []
    for side, (x, y) in _SIDES.items():
        for number, after in ((0, _AHEAD[side]), (1, _LEFT[side])):
            ends = [(x * 210 - y * number * 3, y * 210 + x * number * 3, 0)]
            ends.append((x * 10 - y * number * 3, y * 10 + x * number * 3, 0))
            found.append(lane(f"{side}_{number}", ends, f"out{after}_0"))
        ends = [(x * 10 + y * 4, y * 10 - x * 4, 0), (x * 210 + y * 4, y * 210 - x * 4, 0)]
        found.append(lane(f"out{side}_0", ends))
    return found


_LINKS = [
    Link(
        index=number,
        from_lane=f"{side}_{turn}",
        to_lane=f"out{(_AHEAD if turn == 0 else _LEFT)[side]}_0",
    )
    for number, (side, turn) in enumerate(itertools.product(_SIDES, (0, 1)))
]


def _state(*greens: str, permitted: tuple[str, ...] = ()) -> str:
    return "".join(
        "G" if one.from_lane in greens else "g" if one.from_lane in permitted else "r"
        for one in _LINKS
    )


PHASES = [
    _state("n_0", "s_0", permitted=("n_1", "s_1")),
    _state("n_1", "s_1"),
    _state("e_0", "w_0", permitted=("e_1", "w_1")),
    _state("e_1", "w_1"),
    _state("n_0", "n_1"),
    _state("s_0", "s_1"),
    _state("e_0", "e_1"),
    _state("w_0", "w_1"),
]
_GREEN_TOGETHER = {
    (a, b)
    for phase in PHASES
    for a, b in itertools.combinations(range(8), 2)
    if phase[a] == phase[b] == "G"
}
SIGNAL = Signal(
    tls="j",
    links=_LINKS,
    conflicts=[p for p in itertools.combinations(range(8), 2) if p not in _GREEN_TOGETHER],
    plan=[
        PlanPhase(duration_s=seconds, state=state)
        for phase in PHASES
        for seconds, state in ((10, phase), (5, phase.replace("G", "y").replace("g", "y")))
    ],
)
SITE = SignalSite(SIGNAL, one_junction("crossing", _lanes(), SIGNAL), REACH_M, CabinetTimes())
LANES = SITE.lanes


def vehicles(*rows: tuple[str, float, float], ids: bool = True) -> LaneVehicles:
    """Returns vehicles of (lane, m to the stop bar, m/s)."""
    return LaneVehicles(
        lanes=[row[0] for row in rows],
        distances_m=np.array([row[1] for row in rows], float),
        speeds_mps=np.array([row[2] for row in rows], float),
        lengths_m=np.full(len(rows), 4.5),
        ids=[f"v{n}" if ids else "" for n in range(len(rows))],
    )


def counts(frame: int, time_ns: int, **coverage: float) -> LaneCounts:
    return LaneCounts(
        frame=frame,
        sim_time_ns=time_ns,
        tls="j",
        agents=[],
        complete=True,
        upstream=dict.fromkeys(LANES, 0),
        downstream={},
        coverage_from_bar=coverage,
    )


def green(state: str, time_ns: int, since_ns: int = 0) -> SignalState:
    return SignalState(
        frame=0,
        sim_time_ns=time_ns,
        tls="j",
        state=state,
        stage="green",
        green=state,
        source="test",
        earliest_change_ns=max(time_ns, since_ns + 5 * S),
    )


def seen(second: float, state: str, found: LaneVehicles) -> Observation:
    """Returns an observation of a green that may end."""
    time_ns = round(second * S)
    return Observation(counts(0, time_ns), green(state, time_ns), found)
