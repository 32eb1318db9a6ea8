"""Upload rates and stage times, as a viewer shows them."""

import pytest

from protocol import messages as m
from protocol.errors import MessageError
from tests.viewer.shown import MS, PERIOD_NS, measured, sent, tick
from viewer.stages import GROUPS, LAG_FRAMES, MAX_RATED_AGENTS, Rates, Stages


def test_a_rate_is_that_of_the_last_second_of_complete_frames() -> None:
    rates = Rates(PERIOD_NS)
    for frame in range(30):
        rates.take(sent(frame, "a", 12_500))
    assert rates.mbps(29 * PERIOD_NS) == pytest.approx({"a": 1.0})
    assert rates.mbps(60 * PERIOD_NS) == {}


def test_who_came_just_now_has_its_rate_as_soon_as_its_frame_is_complete() -> None:
    rates = Rates(PERIOD_NS)
    rates.take(sent(100, "a", 12_500))
    assert rates.mbps((99 + LAG_FRAMES) * PERIOD_NS) == {}
    assert rates.mbps((100 + LAG_FRAMES) * PERIOD_NS) == pytest.approx({"a": 1.0})


@pytest.mark.parametrize("period_s", [1, 2])
def test_frames_that_last_a_second_or_more_have_their_rate_though_metrics_come_after_the_tick(
    period_s: int,
) -> None:
    rates = Rates(period_s * 10**9)
    for frame in range(10):
        now_ns = frame * period_s * 10**9
        expected = {"a": 1.0} if frame >= LAG_FRAMES else {}
        assert rates.mbps(now_ns) == pytest.approx(expected)
        upload = sent(frame, "a", period_s * 125_000)
        rates.take(upload.model_copy(update={"sim_time_ns": now_ns}))


def test_a_flood_of_agents_is_bounded() -> None:
    rates = Rates(PERIOD_NS)
    for n in range(MAX_RATED_AGENTS + 10):
        rates.take(sent(0, str(n), 1))
    assert len(rates.mbps(LAG_FRAMES * PERIOD_NS)) == MAX_RATED_AGENTS


def test_every_stage_of_the_account_is_drawn_once() -> None:
    from recording.tables import LatencyRow

    stages = [stage for group in GROUPS.values() for stage in group]
    kept = {name.removesuffix("_ns") for name in LatencyRow._fields if name.endswith("_ns")}
    assert sorted(stages) == sorted(kept - {"end_to_end", "clock_error"})


def feed(stages: Stages, frame: int) -> None:
    upload = m.Upload(
        agent="a", region="r0", chunk=0, points=1, payload_bytes=9, sense_start_ns=0,
        sense_end_ns=4 * MS, encode_end_ns=6 * MS, sent_ns=7 * MS,
    )  # fmt: skip
    arrival = m.Arrival(agent="a", chunk=0, received_ns=9 * MS, decoded_ns=11 * MS)
    stages.take(
        measured(frame, "infra-0", ("sense", "a", 0, 4), ("encode", "a", 4, 6), ("send", "a", 6, 7),
                 uploads=[upload])
    )  # fmt: skip
    stages.take(
        measured(frame, "edge-r0", ("decode", "a", 9, 11), ("wait", "", 9, 12),
                 ("detect", "", 12, 20), arrivals=[arrival])
    )  # fmt: skip
    stages.take(measured(frame, "sim", ("actuate", "J", 25, 26)))


def test_accounts_come_some_frames_later_and_once() -> None:
    stages = Stages(PERIOD_NS, {"r0": ["J"]})
    found = []
    for frame in range(10):
        stages.take(tick(frame))
        found += [frame["r0"] for frame in stages.latencies()]
        feed(stages, frame)
    assert [latency.frame for latency in found] == list(range(10 - LAG_FRAMES))
    latency = found[0]
    assert latency.end_to_end_ms == 26
    assert sum(latency.groups_ms.values()) == pytest.approx(26)
    assert (latency.groups_ms["sense"], latency.groups_ms["detect"]) == (4, 8)


def test_who_comes_late_begins_where_the_world_is() -> None:
    stages = Stages(PERIOD_NS, {"r0": ["J"]})
    with pytest.raises(MessageError):
        stages.take(tick(5000))
    found = []
    for frame in range(5001, 5010):
        stages.take(tick(frame))
        feed(stages, frame)
        found += [frame["r0"] for frame in stages.latencies()]
    assert found
    assert found[-1].frame == 5009 - LAG_FRAMES
