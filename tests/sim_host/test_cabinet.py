"""The cabinet is safe whatever is requested, and obeys requests that are safe."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.messages import SignalRequest
from protocol.roadmap import Signal
from sim_host.cabinet import SignalCabinet
from sim_host.config import CabinetConfig
from tests.sim_host.signals import plan, signals

S = 1_000_000_000
CONFIG = CabinetConfig()


TWO = Signal(tls="J", links=[], conflicts=[(0, 1)], plan=plan("Gr", "rG"))
# Link 0 is straight on, 1 the opposite left turn that yields to it, 2 the crossing road.
YIELD = Signal(
    tls="J", links=[], conflicts=[(0, 1), (0, 2), (1, 2)], plan=plan("Ggr", "rGr", "rrG")
)


def wanted(
    state: str, now_ns: int, tls: str = "J", policy: str = "test", not_before_ns: int = 0
) -> SignalRequest:
    return SignalRequest(
        frame=0,
        sim_time_ns=now_ns,
        tls=tls,
        state=state,
        policy=policy,
        not_before_ns=not_before_ns,
    )


def green_cabinet(signal: Signal, state: str) -> SignalCabinet:
    """Returns a cabinet that shows a green, since 9 s before the time 10 s."""
    cabinet = SignalCabinet(signal, CONFIG)
    for second in range(11):
        cabinet.request(wanted(state, second * S), second * S)
        cabinet.advance(second * S)
    assert cabinet.advance(10 * S) == state
    return cabinet


def test_a_change_runs_through_yellow_and_all_red() -> None:
    cabinet = green_cabinet(TWO, "Gr")
    shown = []
    for second in range(10, 18):
        assert cabinet.request(wanted("rG", second * S + 1), second * S + 1) is None
        shown.append(cabinet.advance(second * S + 1))
    assert shown == ["yr"] * 4 + ["rr"] + ["rG"] * 3


def test_until_a_request_begins_what_was_wanted_before_is_shown() -> None:
    cabinet = green_cabinet(TWO, "Gr")
    later_ns = 10 * S + S // 2
    assert cabinet.request(wanted("rG", 10 * S + 1, not_before_ns=later_ns), 10 * S + 1) is None
    shown = [cabinet.advance(now_ns) for now_ns in (10 * S + 1, later_ns - 1, later_ns)]
    assert shown == ["Gr", "Gr", "yr"]


def test_another_request_replaces_one_that_has_not_begun() -> None:
    cabinet = green_cabinet(TWO, "Gr")
    cabinet.request(wanted("rG", 10 * S + 1, not_before_ns=12 * S), 10 * S + 1)
    cabinet.request(wanted("Gr", 11 * S), 11 * S)
    assert [cabinet.advance(second * S) for second in (11, 12, 13)] == ["Gr"] * 3


def test_what_holds_until_a_request_begins_is_not_stale_before() -> None:
    cabinet, sources = green_cabinet(TWO, "rG"), set()
    for second in range(12, 40, 2):  # a frame each 2 s, each request to begin in 1.5 s
        later_ns = second * S + 3 * S // 2
        request = wanted("rG", second * S, policy="late", not_before_ns=later_ns)
        assert cabinet.request(request, second * S) is None
        for tenth in range(20):
            assert cabinet.advance(second * S + tenth * S // 10) == "rG"
            sources.add(cabinet.spat(0, second * S + tenth * S // 10).source)
    assert sources == {"test", "late"}


def test_requests_that_are_put_off_again_and_again_do_not_keep_an_old_one_alive() -> None:
    cabinet, sources = green_cabinet(TWO, "rG"), []
    for second in range(11, 20):
        later = wanted("Gr", second * S, policy="late", not_before_ns=(second + 2) * S)
        assert cabinet.request(later, second * S) is None
        cabinet.advance(second * S)
        sources.append(cabinet.spat(0, second * S).source)
    assert sources == ["test"] * 3 + ["plan"] * 6


def test_a_green_lasts_its_minimum() -> None:
    cabinet = SignalCabinet(TWO, CONFIG)
    shown = {}
    for tenth in range(150):
        now_ns = tenth * S // 10
        cabinet.request(wanted("Gr" if tenth < 15 else "rG", now_ns), now_ns)
        shown[tenth] = cabinet.advance(now_ns)
    assert [tenth for tenth, state in shown.items() if state == "Gr"] == list(range(10, 60))


def test_it_starts_with_red_for_all() -> None:
    cabinet = SignalCabinet(TWO, CONFIG)
    start = cabinet.spat(0, 5 * S)
    assert (start.state, start.stage, start.earliest_change_ns) == ("rr", "all_red", 6 * S)
    assert cabinet.advance(5 * S) == "rr"
    assert cabinet.advance(6 * S) == "Gr"


def test_without_a_minimum_a_green_may_end_at_the_next_moment() -> None:
    cabinet = SignalCabinet(TWO, CabinetConfig(min_green_s=0))
    assert [cabinet.advance(now_ns) for now_ns in (0, S)] == ["rr", "Gr"]
    assert cabinet.request(wanted("rG", S), S) is None
    assert [cabinet.advance(now_ns) for now_ns in (S, S + 1)] == ["Gr", "yr"]


TURN = Signal(tls="J", links=[], conflicts=[(0, 1)], plan=plan("Gr", "gG", "rG", "gr"))


def test_a_change_that_stops_nobody_is_made_at_once() -> None:
    cabinet = green_cabinet(TURN, "gG")
    assert cabinet.request(wanted("rG", 10 * S + 1), 10 * S + 1) is None
    assert cabinet.advance(10 * S + 1) == "yG"
    cabinet = green_cabinet(TURN, "rG")
    assert cabinet.request(wanted("gG", 10 * S + 1), 10 * S + 1) is None
    assert cabinet.advance(10 * S + 1) == "gG"
    assert cabinet.spat(0, 10 * S + 1).stage == "green"


@pytest.mark.parametrize("yielding", ["gG", "gr"])
def test_a_turn_with_right_of_way_is_stopped_before_it_has_to_yield(yielding: str) -> None:
    # Also where nobody starts: else the next change could let somebody start at once.
    cabinet = green_cabinet(TURN, "Gr")
    assert cabinet.request(wanted(yielding, 10 * S + 1), 10 * S + 1) is None
    assert [cabinet.advance(s * S + 1) for s in (10, 14, 15)] == ["yr", "rr", yielding]


def test_the_plan_changes_at_its_own_times() -> None:
    cabinet = SignalCabinet(TWO, CONFIG)
    shown = {now_ns: cabinet.advance(now_ns) for now_ns in (0, S, 20 * S - 1, 20 * S)}
    assert list(shown.values()) == ["rr", "Gr", "Gr", "yr"]


def test_links_green_before_and_after_keep_their_green() -> None:
    cabinet = green_cabinet(YIELD, "Ggr")
    cabinet.request(wanted("rGr", 10 * S + 1), 10 * S + 1)
    assert cabinet.advance(10 * S + 1) == "ygr"
    assert cabinet.advance(14 * S + 1) == "rgr"
    assert cabinet.advance(15 * S + 1) == "rGr"


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (wanted("Gr", 9 * S, tls="K"), "wrong_tls"),
        (wanted("Grr", 9 * S), "wrong_length"),
        (wanted("Gy", 9 * S), "bad_alphabet"),
        (wanted("GX", 9 * S), "bad_alphabet"),
        (wanted("rr", 9 * S), "no_green"),
        (wanted("Gr", 11 * S), "from_the_future"),
        (wanted("Gr", 9 * S, not_before_ns=13 * S), "begins_too_late"),
        (wanted("Gr", 6 * S), "stale"),
        (wanted("Gr", -9 * S), "stale"),
        (wanted("GG", 9 * S), "conflict"),
        (wanted("Gg", 9 * S), "conflict"),
        (wanted("gg", 9 * S), "conflict"),
    ],
)
def test_what_cannot_be_is_refused_and_counted(request_: SignalRequest, reason: str) -> None:
    cabinet = SignalCabinet(TWO, CONFIG)
    assert cabinet.request(request_, 10 * S) == reason
    assert cabinet.refusals == {reason: 1}


def test_a_replayed_request_is_refused() -> None:
    cabinet = SignalCabinet(TWO, CONFIG)
    assert cabinet.request(wanted("Gr", 9 * S), 9 * S) is None
    assert cabinet.request(wanted("Gr", 9 * S), 10 * S) == "replayed"
    assert cabinet.request(wanted("rG", 8 * S), 10 * S) == "replayed"


def test_a_request_is_not_stale_until_its_time_is_over() -> None:
    stale_ns = round(CONFIG.stale_after_s * S)
    cabinet = SignalCabinet(TWO, CONFIG)
    for now_ns in range(0, 10 * S, S):
        cabinet.advance(now_ns)
    assert cabinet.request(wanted("rG", 10 * S), 10 * S + stale_ns) is None
    cabinet.advance(10 * S + stale_ns)
    assert cabinet.spat(0, 10 * S + stale_ns).green == "rG"


@pytest.mark.parametrize(
    ("state", "fits"), [("Ggr", True), ("ggr", True), ("gGr", False), ("GGr", False)]
)
def test_a_yielding_green_is_taken_only_as_the_plan_shows_it(state: str, fits: bool) -> None:
    refused = SignalCabinet(YIELD, CONFIG).request(wanted(state, 0), 0)
    assert refused == (None if fits else "conflict")


@pytest.mark.parametrize("state", ["Ggrr", "ggrr", "rrgG", "rrgg"])
def test_each_yielding_green_of_a_plan_may_be_asked_for(state: str) -> None:
    signal = Signal(tls="J", links=[], conflicts=[(0, 1), (2, 3)], plan=plan("Ggrr", "rrgG"))
    assert SignalCabinet(signal, CONFIG).request(wanted(state, 0), 0) is None


def test_a_plan_with_two_conflicting_rights_of_way_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match="links 0 and 1"):
        SignalCabinet(Signal(tls="J", links=[], conflicts=[(0, 1)], plan=plan("GG", "rr")), CONFIG)


def test_the_plan_runs_when_requests_stop_and_requests_when_they_return() -> None:
    cabinet = green_cabinet(TWO, "rG")
    for second in range(11, 31):
        cabinet.advance(second * S)
    plan_rules = cabinet.spat(0, 30 * S)
    assert (plan_rules.source, plan_rules.state) == ("plan", "rG")  # as of 25 s of its cycle
    for second in range(31, 45):
        cabinet.request(wanted("Gr", second * S), second * S)
        cabinet.advance(second * S)
    back = cabinet.spat(0, 44 * S)
    assert (back.source, back.state) == ("test", "Gr")


def test_spat_says_what_is_shown_and_until_when_at_least() -> None:
    cabinet = green_cabinet(TWO, "Gr")
    green = cabinet.spat(7, 10 * S)
    assert (green.frame, green.stage, green.green) == (7, "green", "Gr")
    assert green.earliest_change_ns == 10 * S
    cabinet.request(wanted("rG", 11 * S), 11 * S)
    cabinet.advance(11 * S)
    yellow = cabinet.spat(8, 12 * S)
    assert (yellow.stage, yellow.state, yellow.green) == ("yellow", "yr", "rG")
    assert yellow.earliest_change_ns == 15 * S


Steps = list[tuple[int, str | None]]


def steps(size: int) -> st.SearchStrategy[Steps]:
    asked = st.none() | st.text(alphabet="rgGy", min_size=size, max_size=size)
    return st.lists(st.tuples(st.integers(1, 30), asked), min_size=20, max_size=120)


@given(st.data(), signals(), st.sampled_from([0.0, 0.5, 5.0]), st.sampled_from([0.0, 1.0]))
@settings(max_examples=150, deadline=None)
def test_no_requests_whatever_make_it_unsafe(
    data: st.DataObject, signal: Signal, min_green_s: float, all_red_s: float
) -> None:
    config = CabinetConfig(min_green_s=min_green_s, all_red_s=all_red_s, yellow_s=2)
    cabinet = SignalCabinet(signal, config)
    greens = st.sampled_from(signal.greens)
    history: list[tuple[int, str]] = []
    now_ns = 0
    for tenths, asked in data.draw(steps(len(signal.plan[0].state))):
        now_ns += tenths * S // 10
        state = asked if asked is None or "y" in asked else data.draw(greens | st.just(asked))
        if state is not None:
            later_ns = now_ns + data.draw(st.sampled_from([0, 0, S // 2, 5 * S]))
            cabinet.request(wanted(state, now_ns, not_before_ns=later_ns), now_ns)
        history.append((now_ns, cabinet.advance(now_ns)))
    check_no_conflict(signal, [state for _, state in history])
    for link in range(len(signal.plan[0].state)):
        check_times(link, history, config)
        check_right_of_way(link, history, config)
    for pair in signal.conflicts:
        check_clearance(pair, history, config)


def check_no_conflict(signal: Signal, shown: list[str]) -> None:
    for state in shown:
        for a, b in signal.conflicts:
            if state[a] in "Gg" and state[b] in "Gg":
                assert state[a] + state[b] != "GG"
                assert any(g[a] in "Gg" and g[b] in "Gg" for g in signal.planned_greens)


def check_times(link: int, history: list[tuple[int, str]], config: CabinetConfig) -> None:
    """Every green and yellow lasts, and yellow comes after green alone."""
    stage, since_ns = "r", history[0][0]
    least_ns = {"g": config.min_green_s * S, "y": config.yellow_s * S, "r": 0}
    for now_ns, state in history:
        colour = state[link].lower()
        if colour != stage:
            assert (stage, colour) in {("r", "g"), ("g", "y"), ("y", "r")} or (
                (stage, colour) == ("y", "g") and config.all_red_s == 0
            )
            if now_ns != since_ns:
                assert now_ns - since_ns >= least_ns[stage]
            stage, since_ns = colour, now_ns


def check_right_of_way(link: int, history: list[tuple[int, str]], config: CabinetConfig) -> None:
    """Nobody who had right of way yields without having been stopped."""
    for (before_ns, before), (now_ns, after) in pairwise(history):
        if before[link] + after[link] == "Gg":
            assert now_ns - before_ns >= (config.yellow_s + config.all_red_s) * S


def check_clearance(
    pair: tuple[int, int],
    history: list[tuple[int, str]],
    config: CabinetConfig,
) -> None:
    """Who lost a green is followed by a foe only after yellow and all-red."""
    for one, other in (pair, pair[::-1]):
        lost_ns: int | None = None
        for (_, before), (now_ns, after) in pairwise(history):
            if before[one] in "Gg" and after[one] == "y":
                lost_ns = now_ns
            if before[other] not in "Gg" and after[other] in "Gg" and lost_ns is not None:
                assert now_ns - lost_ns >= (config.yellow_s + config.all_red_s) * S
