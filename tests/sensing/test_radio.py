from protocol.inbox import Inbox
from protocol.local import LocalNetwork
from sensing.link.path import on_air_bytes
from sensing.radio import IdealRadio, Passage, RealRadio, VirtualRadio, radio_of

MS = 1_000_000


def scenario(mode: str = "lockstep", **link: object) -> dict[str, object]:
    return {"mode": mode, "seed": 1, "frame_period_s": 0.1, "link": link}


class FullBus:
    """A bus whose link takes 1000 bytes a frame."""

    def __init__(self) -> None:
        self.sent, self.waiting = 0, 0

    def wire_bytes(self) -> int:
        return self.sent

    def unsent_bytes(self) -> int:
        return self.waiting


def test_the_scenario_chooses_the_radio() -> None:
    bus = LocalNetwork().bus(Inbox())
    assert isinstance(radio_of(scenario(), "vehicle", "a", bus), IdealRadio)
    assert isinstance(radio_of(scenario("realtime", profile="lte"), "vehicle", "a", bus), RealRadio)
    assert isinstance(radio_of(scenario(profile="lte"), "vehicle", "a", bus), VirtualRadio)


def test_a_virtual_radio_queues_in_simulated_time_and_says_when_to_skip() -> None:
    bus = LocalNetwork().bus(Inbox())
    radio = radio_of(scenario(profile="1mbit,10ms", agent_compute_ms=4), "vehicle", "a", bus)
    assert not radio.is_clogged(0)
    took_ns = 8_000 * on_air_bytes(20_000)  # 1000 ns a bit
    assert radio.carry(0, 20_000) == Passage(4 * MS, 4 * MS + took_ns + 5 * MS)
    assert radio.is_clogged(0)
    assert not radio.is_clogged(100 * MS)  # less than a frame is left


def test_a_roadside_post_is_wired_unless_it_has_a_profile_of_its_own() -> None:
    bus = LocalNetwork().bus(Inbox())
    wired = radio_of(scenario(profile="1mbit"), "roadside", "rsu-0", bus)
    assert wired.carry(7 * MS, 10**9) == Passage(7 * MS, 7 * MS)
    assert not wired.is_clogged(7 * MS)
    radio = radio_of(scenario(roadside_profile="1mbit"), "roadside", "rsu-0", bus)
    assert radio.carry(0, 10**9) != Passage(0, 0)


def test_a_real_radio_is_clogged_when_more_waits_than_left_in_a_frame() -> None:
    bus = FullBus()
    radio = RealRadio(bus)  # type: ignore[arg-type]
    assert not radio.is_clogged(0)
    bus.sent, bus.waiting = 1000, 900
    assert not radio.is_clogged(0)
    bus.sent, bus.waiting = 2000, 1900
    assert radio.is_clogged(0)
    assert radio.carry(0, 5) is None
