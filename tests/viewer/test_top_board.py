"""The terminal view: rows made from messages."""

import io
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from protocol import messages as m
from protocol.errors import ConfigError, MessageError
from protocol.inbox import Envelope, Presence
from protocol.topics import TOPICS, BusName
from tests.messages import EXAMPLES
from tests.viewer.city import CITY_SETUP
from tests.viewer.shown import PERIOD_NS, SETUP, measured, sent, tick
from viewer import board as boards
from viewer import terminal
from viewer.board import Board
from viewer.stages import LAG_FRAMES
from viewer.terminal import picture

NAMES = {row.message: row.name for row in TOPICS.values()}


def envelope(message: m.Message) -> Envelope:
    return Envelope(NAMES[type(message)], {}, message, 0, b"")


def fed(*messages: m.Message | Presence, setup: m.Setup = SETUP, tls: str | None = None) -> Board:
    board = Board(setup, tls)
    for message in messages:
        board.take(message if isinstance(message, Presence) else envelope(message))
    return board


def state(frame: int, shown: str, stage: str = "green", tls: str = "J") -> m.SignalState:
    return m.SignalState(
        frame=frame, sim_time_ns=frame * PERIOD_NS, tls=tls, state=shown, stage=stage, green="rG",
        source="max_pressure", earliest_change_ns=0,
    )  # fmt: skip


def text(board: Board, width: int = 100) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(picture(board, 0))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_agents_have_their_points_rates_and_scores() -> None:
    scored = measured(0, "edge", scores=[m.AgentScore(agent="b", score=0.2, trusted=False)])
    ticks = (tick(frame) for frame in range(1 + LAG_FRAMES))
    board = fed(sent(0, "a", 12_500), sent(0, "b", 25_000), scored, *ticks)
    rows = [(r.agent, r.points, round(r.mbps, 2), r.score, r.trusted) for r in board.agents()]
    assert rows == [("b", 1, 2.0, 0.2, False), ("a", 1, 1.0, 1.0, True)]
    assert "b is excluded (score 0.20)" in board.alerts(0)


def test_the_signal_is_told_with_the_time_since_its_last_change() -> None:
    changes = state(0, "Gr"), tick(1), state(1, "yr", "yellow"), state(2, "yr", "yellow")
    board = fed(tick(0), *changes, tick(11))
    shown = board.signal()
    assert shown is not None
    assert (shown[0].state, shown[1]) == ("yr", 1.0)
    assert [(row.phase, row.is_shown) for row in board.phase_rows()] == [
        ("south", False),
        ("west", True),
    ]


def test_alerts_tell_of_the_dead_the_incomplete_and_the_dropped() -> None:
    counts = m.LaneCounts(
        frame=1, sim_time_ns=1, tls="J", agents=[], complete=False,
        upstream={"south_0": 4}, downstream={"north_0": 1}, stationary_upstream={"south_0": 2},
        coverage_upstream={"south_0": 0.5}, coasted_upstream={"south_0": 3},
    )  # fmt: skip
    board = fed(
        tick(0),
        counts,
        measured(0, "edge", drops={"late": 7}),
        Presence("vehicle", "vehicle-1", True, BusName.V2X),
        Presence("vehicle", "vehicle-1", False, BusName.V2X),
        Presence("vehicle", "never-seen", False, BusName.V2X),
    )
    assert board.alerts(0) == [
        "vehicle vehicle-1 is gone",
        "1 of the last 1 frames incomplete (1 since this began)",
        "edge dropped 7 × late",
    ]
    assert [vars_of(row) for row in board.lanes("upstream")] == [("south_0", 4, 2, 0.5)]
    shown = text(board)
    for word in ("south_0", "4 (3)", "50%", "dropped 7", "crossing"):
        assert word in shown


def vars_of(row: boards.LaneRow) -> tuple[object, ...]:
    return row.lane, row.vehicles, row.queued, row.seen


def token(role: str, alive: bool, bus: BusName = BusName.WORLD) -> Presence:
    return Presence(role, role, alive, bus)


def test_a_run_that_stands_still_is_told_above_all_tables() -> None:
    board = fed(tick(0), measured(0, "edge", drops={"late": 7}))
    assert board.alerts(boards.STILL_NS)[0] == "no frame for 3 s"
    assert "no frame" not in str(board.alerts(boards.STILL_NS - 1))
    lines = text(board).splitlines()
    (alert,) = [n for n, line in enumerate(lines) if "dropped 7" in line]
    assert alert < 6  # a terminal cuts off what does not fit below
    board.take(Presence("sim", "sim", True, BusName.WORLD))
    board.take(Presence("sim", "sim", False, BusName.WORLD))
    assert "no frame" not in str(board.alerts(boards.STILL_NS))


def test_the_end_is_no_alert() -> None:
    gone = token("sim", alive=False)
    board = fed(token("sim", alive=True), m.End(frames=1, reason="finished"), gone)
    assert board.alerts(0) == []
    assert board.is_over
    assert "ended: finished" in text(board)


def test_a_world_that_is_gone_is_the_end_too() -> None:
    assert fed(token("sim", alive=True), token("sim", alive=False)).is_over


def test_when_the_edge_dies_with_its_router_nobody_else_is_gone() -> None:
    roles = ("edge", "sim", "signal")
    came = [token(role, alive=True, bus=bus) for role in roles for bus in BusName]
    lost = [token(role, alive=False, bus=BusName.V2X) for role in roles]
    board = fed(*came, *lost, token("edge", alive=False))
    assert not board.is_over
    assert board.alerts(0) == ["edge edge is gone"]
    for role in roles:
        board.take(token(role, alive=True, bus=BusName.V2X))
    assert board.alerts(0) == []


@pytest.mark.parametrize("setup", [SETUP, CITY_SETUP])
@pytest.mark.parametrize("width", [20, 40, 80, 200])
def test_every_message_is_taken_and_every_width_has_room(width: int, setup: m.Setup) -> None:
    board = Board(setup)
    for message in EXAMPLES:
        with suppress(MessageError):
            board.take(envelope(message))
    assert all(len(line) <= width for line in text(board, width).splitlines())


def test_in_a_narrow_terminal_names_are_cut_and_numbers_are_whole() -> None:
    side = {f"a_lane_with_a_long_name_{n}": n for n in (12, 3456)}
    lanes = m.LaneCounts(
        frame=0, sim_time_ns=0, tls="J", agents=[], complete=True, upstream=side, downstream={},
        stationary_upstream=side, coverage_upstream=dict.fromkeys(side, 1.0),
    )  # fmt: skip
    lines = text(fed(lanes), 30).splitlines()
    assert all(len(line) <= 30 for line in lines)
    assert any(line.split() == ["upstr…", "vehicles", "queued", "seen"] for line in lines), lines
    assert any(line.split() == ["a_lan…", "3456", "3456", "100%"] for line in lines), lines


def counted(frame: int, tls: str, queued: int, complete: bool = True) -> m.LaneCounts:
    lane = f"{tls}south_0"
    return m.LaneCounts(
        frame=frame, sim_time_ns=frame * PERIOD_NS, tls=tls, agents=["a", "b"], complete=complete,
        upstream={lane: 2 * queued}, downstream={}, stationary_upstream={lane: queued},
        coverage_upstream={lane: 0.25},
    )  # fmt: skip


def to_region(region: str, metrics: m.Metrics) -> m.Metrics:
    uploads = [upload.model_copy(update={"region": region}) for upload in metrics.uploads]
    return metrics.model_copy(update={"uploads": uploads})


CITY = (
    tick(0),
    sent(0, "a", 12_500),
    to_region("r1", sent(0, "b", 25_000)),
    *(state(0, "rG", tls=tls) for tls in "JKL"),
    *(counted(0, tls, n) for n, tls in enumerate("JK")),
    counted(0, "L", 5, complete=False),
    tick(1),
    state(1, "ry", "yellow", tls="K"),
    tick(2),
)


def test_of_several_junctions_all_are_shown_in_their_regions() -> None:
    board = fed(*CITY, setup=CITY_SETUP)
    regions = [(r.region, r.junctions, r.frames, r.incomplete, r.agents) for r in board.regions()]
    assert regions == [("r0", 2, 1, 0, 2), ("r1", 1, 1, 1, 2)]
    assert [row.mbps for row in board.regions()] == [None, None]
    junctions = [
        (r.tls, r.region, r.phase, r.stage, r.since_s, r.vehicles, r.queued, r.covered)
        for r in board.junctions()
    ]
    assert junctions == [
        ("J", "r0", "Jwest", "green", 0.2, 0, 0, 0.25),
        ("K", "r0", "Kwest", "yellow", 0.1, 2, 1, 0.25),
        ("L", "r1", "Lwest", "green", 0.2, 10, 5, 0.25),
    ]
    assert board.alerts(0) == ["r1: 1 of the last 1 frames incomplete (1 since this began)"]
    shown = text(board)
    for word in ("incomplete", "Lwest", "25%", "r1"):
        assert word in shown


def test_rates_of_regions_are_those_that_the_recorder_publishes() -> None:
    progress = next(example for example in EXAMPLES if isinstance(example, m.Progress))
    board = fed(*CITY, progress, setup=CITY_SETUP)
    assert [(row.region, row.mbps) for row in board.regions()] == [("r0", 5), ("r1", None)]
    assert "5.00" in text(board)


def test_one_junction_of_several_is_shown_as_if_it_were_alone() -> None:
    ticks = (tick(frame) for frame in range(3, 1 + LAG_FRAMES))
    board = fed(*CITY, *ticks, setup=CITY_SETUP, tls="K")
    assert board.regions() == [] == board.junctions()
    assert [(row.phase, row.is_shown) for row in board.phase_rows()] == [
        ("Ksouth", False),
        ("Kwest", True),
    ]
    assert [vars_of(row) for row in board.lanes("upstream")] == [("Ksouth_0", 2, 1, 0.25)]
    assert [row.agent for row in board.agents()] == ["a"]  # b uploads to the other region alone
    assert board.alerts(0) == []


def test_the_only_junction_needs_no_name() -> None:
    by_name, without = (fed(tick(0), state(0, "rG"), tls=tls) for tls in ("J", None))
    assert text(by_name) == text(without)


def test_an_unknown_signal_is_refused_with_those_near_it() -> None:
    with pytest.raises(ConfigError, match="none of the run's 3 signals; they are: J, K, L"):
        Board(CITY_SETUP, "j")


def test_of_many_junctions_those_with_the_longest_queues_are_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(terminal, "MAX_JUNCTIONS", 2)
    shown = text(fed(*CITY, setup=CITY_SETUP))
    assert "Kwest" in shown
    assert "Lwest" in shown
    assert "Jwest" not in shown
    assert "and 1 with" in shown


@given(st.lists(st.sampled_from(EXAMPLES), max_size=20))
def test_no_order_of_messages_breaks_the_picture(messages: list[m.Message]) -> None:
    board = Board(SETUP)
    for message in messages:
        with suppress(MessageError):
            board.take(envelope(message))
    assert text(board)
