from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Inbox
from protocol.messages import NEVER_NS
from protocol.traffic import on_air_bytes
from sensing.link_config import LinkConfig
from sensing.radio import AgentKind, IdealRadio, Radio, RealRadio, VirtualRadio, radio_of

MS = 1_000_000


def radio(kind: AgentKind = "vehicle", mode: str = "lockstep", **link: object) -> Radio:
    scenario = {"mode": mode, "seed": 1, "frame_period_s": 0.1}
    bus = InProcessRouter().bus(Inbox())
    return radio_of(scenario, LinkConfig.model_validate(link), kind, "a", bus)


class FullBus(InProcessBus):
    """A bus whose link takes 1000 bytes a frame."""

    def __init__(self) -> None:
        super().__init__(InProcessRouter(), Inbox())
        self.sent, self.waiting = 0, 0

    def wire_bytes(self) -> int:
        return self.sent

    def unsent_bytes(self) -> int:
        return self.waiting


def test_mode_and_link_choose_the_radio() -> None:
    assert isinstance(radio(), IdealRadio)
    assert isinstance(radio(mode="realtime", profile="lte"), RealRadio)
    assert isinstance(radio(profile="lte"), VirtualRadio)


def test_a_virtual_radio_queues_in_simulated_time_and_says_when_to_skip() -> None:
    made = radio(profile="1mbit,10ms", agent_compute_ms=4)
    assert not made.is_congested(0)
    latency_ns = 8_000 * on_air_bytes(20_000)  # 1000 ns a bit
    transmission = made.transmit(0, 20_000, is_chunk=True)
    assert transmission is not None
    assert (transmission.sent_ns, transmission.arrival_ns) == (4 * MS, 4 * MS + latency_ns + 5 * MS)
    assert made.is_congested(0)
    assert not made.is_congested(100 * MS)  # less than a frame is left
    assert made.traffic().data_sent_bytes == on_air_bytes(20_000)


def test_chunks_that_a_new_frame_overtakes_never_arrive_and_take_nothing_of_the_link() -> None:
    made = radio(profile="1mbit,10ms")
    arrivals = [made.transmit(0, 10_000, is_chunk=True) for _ in range(3)]  # 83 ms each
    assert [p is not None and p.arrival_ns == NEVER_NS for p in arrivals] == [False, False, True]
    assert made.begin(100 * MS, None) == 1
    assert made.traffic().data_sent_bytes == 2 * on_air_bytes(10_000)


def test_chunks_are_given_up_once_the_agent_hears_that_it_is_enough() -> None:
    made = radio(profile="1mbit,10ms")
    for _ in range(3):
        made.transmit(0, 5_000, is_chunk=True)  # 41 ms each
    assert made.begin(100 * MS, enough_sim_ns=30 * MS) == 2  # it receives that 5 ms later
    assert made.traffic().data_sent_bytes == on_air_bytes(5_000)


def test_a_pose_is_never_given_up() -> None:
    made = radio(profile="1mbit")
    for is_chunk in (True, False):
        made.transmit(0, 5_000, is_chunk=is_chunk)
    assert made.begin(0, None) == 0


def test_a_roadside_post_is_wired_unless_it_has_a_profile_of_its_own() -> None:
    wired = radio("roadside", profile="1mbit")
    transmission = wired.transmit(7 * MS, 10**9, is_chunk=True)
    assert transmission is not None
    assert (transmission.sent_ns, transmission.arrival_ns) == (7 * MS, 7 * MS)
    assert not wired.is_congested(7 * MS)
    linked = radio("roadside", roadside_profile="1mbit").transmit(0, 10**9, is_chunk=True)
    assert linked is not None
    assert linked.arrival_ns > 0


def test_a_real_radio_is_clogged_when_more_waits_than_left_in_a_frame() -> None:
    bus = FullBus()
    made = RealRadio(bus)
    assert not made.is_congested(0)
    bus.sent, bus.waiting = 1000, 900
    assert not made.is_congested(0)
    bus.sent, bus.waiting = 2000, 1900
    assert made.is_congested(0)
    assert made.transmit(0, 5, is_chunk=True) is None
